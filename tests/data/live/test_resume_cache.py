# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from structgstream.data.live.resume_cache import (
    LAST,
    ResumeCache,
    read_pictures,
    residuals,
    restored,
    resume_folder,
    write_pictures,
)
from structgstream.errors import CaptureError, StorageError
from structgstream.frames import MultiViewFrame


def some_frame(index: int = 7) -> MultiViewFrame:
    random = np.random.default_rng(index)
    images = {name: random.integers(0, 256, (12, 16 + n, 3)).astype(np.uint8) for n, name in enumerate("abc")}
    return MultiViewFrame(index, 0.25, images, {"b": random.random((12, 17)) < 0.5}, 1.7e9)


def test_pictures_masks_and_times_come_back(tmp_path: Path) -> None:
    path, frame = tmp_path / "x", some_frame()
    write_pictures(path, frame, origin_seconds=4.5)
    read, origin = read_pictures(path)
    assert (read.index, read.pts_seconds, read.captured_unix_seconds) == (7, 0.25, 1.7e9)
    assert origin == 4.5
    assert [*read.images] == ["a", "b", "c"]
    assert all((read.images[name] == frame.images[name]).all() for name in "abc")
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


def test_a_file_that_is_cut_or_changed_anywhere_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x"
    write_pictures(path, some_frame(), origin_seconds=0.0)
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
    write_pictures(path, some_frame(), origin_seconds=0.0)
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(CaptureError, match="damaged"):
        read_pictures(path)


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be written"):
        write_pictures(tmp_path / "none" / "x", some_frame(), origin_seconds=0.0)


def frame(index: int) -> MultiViewFrame:
    return replace(some_frame(index), pts_seconds=index / 4)


def cache(folder: Path, *, resume: bool = False) -> ResumeCache:
    return ResumeCache(folder, cameras=("a", "b"), resume=resume)


def test_the_folder_lies_beside_the_stream() -> None:
    assert resume_folder(Path("takes/one.27")) == Path("takes/one.27.live")


def test_frame_0_and_the_last_frames_are_kept_and_no_more(tmp_path: Path) -> None:
    frames = cache(tmp_path / "x.live")
    for index in range(20):
        frames.store(frame(index), origin_seconds=100.0)
        assert len(list((tmp_path / "x.live").glob("frame-*"))) <= 1 + LAST
    again = cache(tmp_path / "x.live", resume=True)
    assert [one.index for one in again.frames(18)] == [18, 19]
    first = next(again.frames(0))
    assert (first.images["a"] == frame(0).images["a"]).all()
    assert [*first.images] == ["a", "b"]  # no held-out camera
    assert again.last() == (19 / 4, 100.0)
    assert list(again.frames(20)) == []


def test_frames_of_a_stream_of_months_are_found_and_removed(tmp_path: Path) -> None:
    """Their numbers have more digits than names are filled up to."""
    frames = cache(tmp_path / "x.live")
    for index in range(10**8 - 3, 10**8 + 6):
        frames.store(frame(index), origin_seconds=100.0)
    assert len(list((tmp_path / "x.live").glob("frame-*"))) <= 1 + LAST
    again = cache(tmp_path / "x.live", resume=True).last()
    assert again == ((10**8 + 5) / 4, 100.0)


@pytest.mark.parametrize(
    ("firsts", "last", "kept"), [((11,), 4, [11, *range(14, 20)]), ((4, 6), 0, [4, 6, 17, 18, 19])]
)
def test_what_periods_need_is_kept_instead(tmp_path: Path, firsts: tuple[int, ...], last: int, kept: list[int]) -> None:
    """Those of several qualities need not begin with the same frame."""
    frames = cache(tmp_path / "x.live")
    for index in range(20):
        frames.store(frame(index), origin_seconds=0.0)
        if index == firsts[-1]:
            frames.retain(*firsts, last=last)
    assert sorted(int(file.name[6:14]) for file in (tmp_path / "x.live").glob("frame-*")) == kept


def test_of_a_frame_that_shows_nothing_the_noise_is_not_kept(tmp_path: Path) -> None:
    frames, sizes = cache(tmp_path / "x.live"), []
    noise = np.random.default_rng(0).integers(7, 10, (480, 640, 3), dtype=np.uint8)
    for index, image in enumerate((noise, noise, 20 * noise)):
        frames.store(MultiViewFrame(index, index / 4, dict.fromkeys("ab", image)), origin_seconds=0.0)
        sizes.append((tmp_path / "x.live" / f"frame-{index:08d}.pictures").stat().st_size)
    assert 50 * sizes[1] < sizes[2]
    assert not next(cache(tmp_path / "x.live", resume=True).frames(1)).showing(["a"])


def test_frames_of_a_run_that_was_resumed_earlier_are_removed(tmp_path: Path) -> None:
    """A stream that lost its last frames goes on before those that are kept."""
    frames = cache(tmp_path / "x.live")
    for index in (*range(6), 4):
        frames.store(frame(index), origin_seconds=0.0)
    assert [one.index for one in frames.frames(3)] == [3, 4]


def test_another_stream_begins_without_them(tmp_path: Path) -> None:
    cache(tmp_path / "x.live").store(frame(0), origin_seconds=0.0)
    cache(tmp_path / "x.live").store(replace(frame(0), pts_seconds=9.0), origin_seconds=0.0)
    assert [one.pts_seconds for one in cache(tmp_path / "x.live", resume=True).frames(0)] == [9.0]


def test_what_may_be_removed_stays_until_the_first_frame_is_kept(tmp_path: Path) -> None:
    """Until then the stream that it belongs to is there, too."""
    cache(tmp_path / "x.live").store(frame(0), origin_seconds=0.0)
    cache(tmp_path / "x.live")
    assert [one.index for one in cache(tmp_path / "x.live", resume=True).frames(0)] == [0]


def test_a_folder_of_others_is_refused_and_stays(tmp_path: Path) -> None:
    (tmp_path / "frame-00000000.pictures").write_bytes(b"mine")
    for resume in (False, True):
        with pytest.raises(StorageError, match="somebody else's; nothing in it was changed"):
            cache(tmp_path, resume=resume)
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"mine"]


def test_without_the_pictures_a_stream_cannot_go_on(tmp_path: Path) -> None:
    frames = cache(tmp_path / "x.live")
    with pytest.raises(CaptureError, match="frame 5 are not in .* cannot be resumed"):
        list(frames.frames(5))
    frames.store(frame(5), origin_seconds=0.0)
    (file,) = (tmp_path / "x.live").glob("frame-*")
    file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(CaptureError, match="damaged.*begin another"):
        list(frames.frames(5))
