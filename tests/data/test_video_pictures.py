# SPDX-License-Identifier: Apache-2.0
"""Pictures by time stamp, and what counts as damage; as a capture they are read in ``test_video``."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.video import pictures_at
from structgstream.data.video_index import VideoTrack, scan_videos
from structgstream.errors import CaptureError
from tests.support.captures import HEIGHT, WIDTH, numbers, picture, write_video

FRAMES = 16  # in groups of four
Damages = list[tuple[int, int | None, str]]


def track_of(folder: Path, *, noisy: bool = False) -> VideoTrack:
    """Numbered pictures with B-frames; with noise in them the file is large."""
    generator = np.random.default_rng(0)
    pictures = [picture(3, number) for number in range(FRAMES)]
    if noisy:
        pictures = [generator.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in pictures]
    write_video(folder / "a.mp4", pictures)
    return scan_videos({"a": folder / "a.mp4"})["a"]


def read(track: VideoTrack, stamps: list[int | None]) -> tuple[list, Damages]:
    damages: Damages = []
    shown = pictures_at(track, stamps, size=(WIDTH, HEIGHT), on_damage=lambda *reported: damages.append(reported))
    found = [None if one is None else one[0] for one in shown]
    return found, damages


def test_any_ascending_choice_of_frames_is_exact(tmp_path: Path) -> None:
    track = track_of(tmp_path)
    for chosen in ([0, 1, 2], [5], [2, 7, 15], [11, 12]):
        found, damages = read(track, [track.stamps[number] for number in chosen])
        assert [numbers(image) for image in found] == [(3, number) for number in chosen]
        assert damages == []


def test_where_nothing_is_wanted_there_is_no_picture(tmp_path: Path) -> None:
    track = track_of(tmp_path)
    found, _ = read(track, [None, track.stamps[4], None, track.stamps[6], None])
    assert [image is None for image in found] == [True, False, True, False, True]
    assert [numbers(image) for image in found if image is not None] == [(3, 4), (3, 6)]
    gone = replace(track, path=tmp_path / "gone.mp4")
    assert read(gone, [None, None]) == ([None, None], [])  # not even opened


def test_a_video_whose_size_changes_is_refused_where_it_does(tmp_path: Path) -> None:
    track = replace(track_of(tmp_path), width=2 * WIDTH, height=2 * HEIGHT)  # As its first frames may have had.
    with pytest.raises(
        CaptureError, match=f"changes its size from {2 * WIDTH}x{2 * HEIGHT} to {WIDTH}x{HEIGHT} at 0.3"
    ):
        read(track, [track.stamps[9]])


@pytest.mark.parametrize("share", [0.6, 0.97])
def test_damage_is_reported_with_what_is_lost_up_to_the_next_key_frame(tmp_path: Path, share: float) -> None:
    track = track_of(tmp_path, noisy=True)
    data = bytearray(track.path.read_bytes())
    middle = int(share * len(data))
    data[middle : middle + 4000] = bytes(len(data[middle : middle + 4000]))
    track.path.write_bytes(data)
    found, ((lost, following, reason),) = read(track, list(track.stamps))
    end = len(track.stamps) if following is None else track.stamps.index(following)
    assert [number for number, image in enumerate(found) if image is None] == list(range(track.stamps.index(lost), end))
    assert (following is None) == (share == 0.97)
    assert following is None or following in track.keyframes
    assert reason
