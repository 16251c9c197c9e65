# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.live.kept import LAST, KeptFrames, kept_folder
from structgstream.errors import CaptureError, StorageError
from structgstream.frames import MultiViewFrame
from tests.data.live.test_picture_file import some_frame


def frame(index: int) -> MultiViewFrame:
    return replace(some_frame(index), pts_seconds=index / 4)


def kept(folder: Path, *, resume: bool = False) -> KeptFrames:
    return KeptFrames(folder, cameras=("a",), resume=resume)


def test_the_folder_lies_beside_the_stream() -> None:
    assert kept_folder(Path("takes/one.27")) == Path("takes/one.27.live")


def test_frame_0_and_the_last_frames_are_kept_and_no_more(tmp_path: Path) -> None:
    frames = kept(tmp_path / "x.live")
    for index in range(20):
        frames.keep(frame(index), origin_seconds=100.0)
        assert len(list((tmp_path / "x.live").glob("frame-*"))) <= 1 + LAST
    again = kept(tmp_path / "x.live", resume=True)
    assert [one.index for one in again.following(18)] == [18, 19]
    first = next(again.following(0))
    assert (first.images["a"] == frame(0).images["a"]).all()
    assert [*first.images] == ["a"]  # no held-out camera
    assert again.last() == (19 / 4, 100.0)
    assert list(again.following(20)) == []


def test_what_a_period_needs_is_kept_instead(tmp_path: Path) -> None:
    frames = kept(tmp_path / "x.live")
    for index in range(20):
        frames.keep(frame(index), origin_seconds=0.0)
        if index == 12:
            frames.need(11, last=4)
    found = sorted(int(file.name[6:14]) for file in (tmp_path / "x.live").glob("frame-*"))
    assert found == [11, *range(14, 20)]


def test_of_a_frame_that_shows_nothing_the_noise_is_not_kept(tmp_path: Path) -> None:
    frames, sizes = kept(tmp_path / "x.live"), []
    noise = np.random.default_rng(0).integers(7, 10, (480, 640, 3), dtype=np.uint8)
    for index, image in enumerate((noise, noise, 20 * noise)):
        frames.keep(MultiViewFrame(index, index / 4, {"a": image}), origin_seconds=0.0)
        sizes.append((tmp_path / "x.live" / f"frame-{index:08d}.pictures").stat().st_size)
    assert 50 * sizes[1] < sizes[2]
    assert not next(kept(tmp_path / "x.live", resume=True).following(1)).showing(["a"])


def test_several_periods_keep_a_first_frame_each(tmp_path: Path) -> None:
    """As those of several qualities, which need not begin with the same frame."""
    frames = kept(tmp_path / "x.live")
    for index in range(20):
        frames.keep(frame(index), origin_seconds=0.0)
        if index == 6:
            frames.need(4, 6, last=0)
    found = sorted(int(file.name[6:14]) for file in (tmp_path / "x.live").glob("frame-*"))
    assert found == [4, 6, 17, 18, 19]


def test_frames_of_a_run_that_was_resumed_earlier_are_removed(tmp_path: Path) -> None:
    """A stream that lost its last frames goes on before those that are kept."""
    frames = kept(tmp_path / "x.live")
    for index in (*range(6), 4):
        frames.keep(frame(index), origin_seconds=0.0)
    assert [one.index for one in frames.following(3)] == [3, 4]


def test_another_stream_begins_without_them(tmp_path: Path) -> None:
    kept(tmp_path / "x.live").keep(frame(0), origin_seconds=0.0)
    kept(tmp_path / "x.live").keep(replace(frame(0), pts_seconds=9.0), origin_seconds=0.0)
    assert [one.pts_seconds for one in kept(tmp_path / "x.live", resume=True).following(0)] == [9.0]


def test_what_may_be_removed_stays_until_the_first_frame_is_kept(tmp_path: Path) -> None:
    """Until then the stream that it belongs to is there, too."""
    kept(tmp_path / "x.live").keep(frame(0), origin_seconds=0.0)
    kept(tmp_path / "x.live")
    assert [one.index for one in kept(tmp_path / "x.live", resume=True).following(0)] == [0]


def test_a_folder_of_others_is_refused_and_stays(tmp_path: Path) -> None:
    (tmp_path / "frame-00000000.pictures").write_bytes(b"mine")
    for resume in (False, True):
        with pytest.raises(StorageError, match="somebody else's; nothing in it was changed"):
            kept(tmp_path, resume=resume)
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"mine"]


def test_without_the_pictures_a_stream_cannot_go_on(tmp_path: Path) -> None:
    frames = kept(tmp_path / "x.live")
    with pytest.raises(CaptureError, match="frame 5 are not in .* cannot be resumed"):
        list(frames.following(5))
    frames.keep(frame(5), origin_seconds=0.0)
    (file,) = (tmp_path / "x.live").glob("frame-*")
    file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(CaptureError, match="damaged.*begin another"):
        list(frames.following(5))
