# SPDX-License-Identifier: Apache-2.0
"""Segments become an ordinary stream."""

import shutil
from pathlib import Path

import pytest

from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.errors import ConfigError, StreamError
from structgstream.groups import join
from structgstream.groups.join import check_births, join_segments
from structgstream.training.online.patching import IDS_PER_FRAME
from tests.support.clip_groups import FRAMES, LENGTH, made
from tests.support.streams import moved, small_scene, write_stream


def test_the_result_is_an_ordinary_stream(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    assert join_segments(made().segments[::-1], path, check=True) == FRAMES
    with open_stream(path) as by_scan, open_stream(path, by_index=True) as by_index:
        assert by_scan.complete
        assert [info.index for info in by_scan.packets] == [*range(FRAMES)]
        assert [info.index for info in by_index.packets] == [*range(FRAMES)]
        keys = [info.index for info in by_scan.packets if info.kind is PacketKind.KEY]
        assert keys == [*range(0, FRAMES, LENGTH)]
        births = [int(b) for _, scene in by_scan.scenes() for b in scene.free.births]
        assert all(b // IDS_PER_FRAME < FRAMES for b in births)
    assert [*tmp_path.iterdir()] == [path]


def test_gaps_overlaps_and_damage_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    first, second, third = made().segments
    path = tmp_path / "a.sgs"
    with pytest.raises(StreamError, match="Frames 2 to 3 are missing"):
        join_segments([first, third], path)
    with pytest.raises(StreamError, match="Frames 0 to 1 are missing"):
        join_segments([second, third], path)
    with pytest.raises(StreamError, match="Frames 2 to 3 are duplicated"):
        join_segments([first, second, second, third], path)
    with pytest.raises(ConfigError, match="nothing to join"):
        join_segments([], path)
    with pytest.raises(StreamError, match="not a segment"):
        join_segments([made().header], path)
    damaged = tmp_path / "g.sgs"
    shutil.copy(second, damaged)
    data = bytearray(damaged.read_bytes())
    data[-60] ^= 4
    damaged.write_bytes(data)
    with pytest.raises(StreamError, match="is not finished or damaged"):
        join_segments([first, damaged, third], path)
    damaged.unlink()
    assert not [*tmp_path.iterdir()]


def test_births_of_another_group_are_found(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    scenes = [moved(small_scene(), number) for number in range(4)]  # Frame 3 has three births of frame 0.
    write_stream(FileSink(path), scenes)
    check_births(path, [0])
    with pytest.raises(StreamError, match="Frame 2 .* spawned in frames 0 to 0; its group begins at frame 2"):
        check_births(path, [0, 2])


def test_a_result_that_fails_its_check_replaces_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.sgs"
    path.write_bytes(b"good")

    def refuse(found: Path, firsts: list[int]) -> None:
        with open_stream(found) as reader:
            assert len(reader) == FRAMES
        raise StreamError(f"{firsts}")

    monkeypatch.setattr(join, "check_births", refuse)
    with pytest.raises(StreamError, match="0, 2, 4"):
        join_segments(made().segments, path, check=True)
    assert path.read_bytes() == b"good"
    assert [*tmp_path.iterdir()] == [path]
