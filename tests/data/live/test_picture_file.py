# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from structgstream.data.live import picture_file
from structgstream.data.live.picture_file import (
    FORMAT,
    WITHOUT_RESIDUALS,
    read_pictures,
    residuals,
    restored,
    write_pictures,
)
from structgstream.errors import CaptureError, StorageError
from structgstream.frames import MultiViewFrame


def some_frame(index: int = 7) -> MultiViewFrame:
    random = np.random.default_rng(index)
    images = {name: random.integers(0, 256, (12, 16 + n, 3)).astype(np.uint8) for n, name in enumerate("ab")}
    return MultiViewFrame(index, 0.25, images, {"b": random.random((12, 17)) < 0.5}, 1.7e9)


def test_pictures_masks_times_and_facts_come_back(tmp_path: Path) -> None:
    path, frame = tmp_path / "x", some_frame()
    assert write_pictures(path, frame, sync=True, origin_seconds=4.5) == path.stat().st_size
    read, facts = read_pictures(path)
    assert (read.index, read.pts_seconds, read.captured_unix_seconds) == (7, 0.25, 1.7e9)
    assert facts == {"origin_seconds": 4.5}
    assert [*read.images] == ["a", "b"]
    assert all((read.images[name] == frame.images[name]).all() for name in "ab")
    assert (read.masks["b"] == frame.masks["b"]).all()
    assert read.masks["b"].dtype == bool


@given(arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))), st.booleans())
def test_residuals_give_back_every_picture(image: np.ndarray, mirrored: bool) -> None:
    view = image[:, ::-1] if mirrored else image
    before = view.copy()
    found = residuals(view)
    assert np.array_equal(view, before), "the picture is left as it was"
    assert np.array_equal(restored(found.reshape(view.shape)), view)


def test_a_plane_leaves_nothing_but_its_edges() -> None:
    down, across = np.mgrid[:40, :60]
    image = np.stack([2 * down + across + offset for offset in (3, 50, 200)], axis=2).astype(np.uint8)
    assert not residuals(image)[:, 1:, 1:].any()


def test_files_of_an_earlier_version_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, frame = tmp_path / "x", some_frame()
    monkeypatch.setattr(picture_file, "residuals", lambda image: image)
    write_pictures(path, frame, sync=False)
    path.write_bytes(path.read_bytes().replace(FORMAT.encode(), WITHOUT_RESIDUALS.encode()))
    read, _ = read_pictures(path)
    assert all((read.images[name] == frame.images[name]).all() for name in "ab")


def test_a_file_that_is_cut_or_changed_anywhere_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x"
    write_pictures(path, some_frame(), sync=False)
    whole = path.read_bytes()
    for cut in range(0, len(whole), 37):
        path.write_bytes(whole[:cut])
        with pytest.raises(CaptureError, match="damaged"):
            read_pictures(path)
    head = whole.index(b"\n") + 1
    for at in range(head, len(whole), 41):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(CaptureError, match="damaged"):
            read_pictures(path)


@pytest.mark.parametrize(
    ("old", "new"), [(b"[12, 16, 3]", b"[99999999, 16, 3]"), (b"[12, 16, 3]", b"[12, 16, 4]"), (b"pictures-2", b"x")]
)
def test_a_header_of_other_numbers_is_refused(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = tmp_path / "x"
    write_pictures(path, some_frame(), sync=False)
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(CaptureError, match="damaged"):
        read_pictures(path)


def test_what_cannot_be_written_or_found_is_said(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be written"):
        write_pictures(tmp_path / "none" / "x", some_frame(), sync=False)
    with pytest.raises(CaptureError, match="are missing"):
        read_pictures(tmp_path / "x")
