# SPDX-License-Identifier: Apache-2.0
"""A written video plays, with the right colours, or is not there."""

import errno
import os
from pathlib import Path

import av
import numpy as np
import pytest

from structgstream.atomic_files import partial_path
from structgstream.data.video_writer import VideoWriter
from structgstream.errors import StorageError


def gradient(number: int, *, height: int = 48, width: int = 64) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 3, y * 4, np.full_like(x, 20 * number)], axis=2).astype(np.uint8)


def test_a_player_sees_every_frame_in_its_colours(tmp_path: Path) -> None:
    path = tmp_path / "new" / "path.mp4"
    with VideoWriter(path, fps=24) as video:
        for number in range(5):
            video.write(gradient(number))
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt, context.colorspace, context.color_range) == (
            "h264",
            "yuv420p",
            1,
            1,
        )
        assert stream.average_rate == 24
        frames = [
            frame.reformat(format="rgb24", src_colorspace=1, src_color_range=1, dst_color_range=2).to_ndarray()
            for frame in container.decode(video=0)
        ]
    assert len(frames) == 5
    for number, frame in enumerate(frames):
        # CRF 18 and 4:2:0 on a smooth picture: a few levels; a wrong matrix or range shifts more.
        assert np.abs(frame.astype(int) - gradient(number)).mean() < 4
    assert [entry.name for entry in path.parent.iterdir()] == ["path.mp4"]


@pytest.mark.parametrize("channels", [None, 1])
def test_pictures_come_at_their_times_with_and_without_sound(channels: int | None, tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "v.mp4", fps=30, channels=channels) as video:
        for number, seconds in enumerate((0.0, 2.0, 2.5)):
            video.write(gradient(number), seconds=seconds)
    with av.open(str(tmp_path / "v.mp4")) as container:
        assert [frame.time for frame in container.decode(video=0)] == [0.0, 2.0, 2.5]


def test_an_odd_size_is_padded(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "odd.mp4", fps=29.97) as video:
        video.write(gradient(0, height=33, width=41))
    with av.open(str(tmp_path / "odd.mp4")) as container:
        assert (container.streams.video[0].width, container.streams.video[0].height) == (42, 34)


def test_an_error_leaves_no_half_written_file(tmp_path: Path) -> None:
    def interrupted() -> None:
        with VideoWriter(tmp_path / "v.mp4", fps=30) as video:
            video.write(gradient(0))
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_refuses_is_said_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk, and a read-only one, which refuses to remove a file that is not there, too."""
    if not os.access("/dev/full", os.W_OK):
        pytest.skip("this system has no /dev/full")

    def refused(path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    partial_path(tmp_path / "v.mp4").symlink_to("/dev/full")
    monkeypatch.setattr(Path, "unlink", refused)

    def full() -> None:
        with VideoWriter(tmp_path / "v.mp4", fps=30) as video:
            video.write(gradient(0))

    with pytest.raises(StorageError, match=r"v\.mp4 cannot be written \(No space left on device\); make room\.$"):
        full()


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"v\.mp4 cannot be written"):
        VideoWriter(tmp_path / "file" / "v.mp4", fps=30)
