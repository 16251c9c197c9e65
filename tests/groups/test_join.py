# SPDX-License-Identifier: Apache-2.0
"""Segments become an ordinary stream, also with borders that one process or several blend."""

from contextlib import closing
from functools import cache
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.errors import ConfigError, StreamError, TaskError
from structgstream.executors.tasks import PYTHON, Task
from structgstream.groups import join, seam_blend
from structgstream.groups.base import GroupBase, open_for
from structgstream.groups.join import MAX_GROUPS, check_births, join_segments, runs_of
from structgstream.groups.seam_blend import FADE_FRAMES, OWN_FRAMES, Border
from structgstream.groups.track_pass import track_capture
from structgstream.scene.scene import Scene
from structgstream.training.online.patching import IDS_PER_FRAME
from tests.support.backends import quickest_backend
from tests.support.clip_groups import CAPTURE, FRAMES, LENGTH, OPTIONS, Made, fit, made, task
from tests.support.inline_engine import InlineEngine
from tests.support.shared_folder import made_once
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
    damaged, data = tmp_path / "g.sgs", bytearray(second.read_bytes())
    data[-60] ^= 4
    damaged.write_bytes(data)
    for segments, error, said in (
        ([first, third], StreamError, "Frames 2 to 3 are missing"),
        ([second, third], StreamError, "Frames 0 to 1 are missing"),
        ([first, second, second, third], StreamError, "Frames 2 to 3 are duplicated"),
        ([], ConfigError, "nothing to join"),
        ([made().header], StreamError, "not a segment"),
        ([first, damaged, third], StreamError, "is not finished or damaged"),
    ):
        with pytest.raises(error, match=said):
            join_segments(segments, path)
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


def scenes_of(path: Path) -> list[Scene]:
    with open_stream(path) as reader:
        return [scene for _, scene in reader.scenes()]


def unmoved(one: Scene, other: Scene) -> int:
    return int((one.anchors.positions == other.anchors.positions).all(1).sum())


def test_more_anchors_keep_their_bits_across_borders(tmp_path: Path) -> None:
    plain, handed = tmp_path / "plain.sgs", tmp_path / "handed.sgs"
    join_segments(made().segments, plain, check=True)
    borders: list[Border] = []
    backend = quickest_backend()
    assert join_segments(made().segments, handed, check=True, backend=backend, on_border=borders.append) == FRAMES
    assert [border.frame for border in borders] == list(range(LENGTH, FRAMES, LENGTH))
    assert all(border.blended > 0 <= border.withdrawn for border in borders)
    before, after = scenes_of(plain), scenes_of(handed)
    for index in range(LENGTH):
        assert torch.equal(before[index].anchors.positions, after[index].anchors.positions)
    for border in range(LENGTH, FRAMES, LENGTH):
        assert unmoved(after[border - 1], after[border]) > unmoved(before[border - 1], before[border])
    with open_stream(plain) as one, open_stream(handed) as other:
        assert [info.kind for info in one.packets] == [info.kind for info in other.packets]
        assert [info.pts_seconds for info in one.packets] == [info.pts_seconds for info in other.packets]
        assert other.packets[LENGTH].kind is PacketKind.KEY


LONG = OWN_FRAMES - FADE_FRAMES + 1
"""What :data:`OWN_FRAMES` is where differences fade in one frame."""
LONG_FRAMES = LONG + 4
BORDERS = (2, 2 + LONG)
RANGES = [(0, BORDERS[0]), (BORDERS[0], BORDERS[1]), (BORDERS[1], LONG_FRAMES)]


@cache
def long_groups() -> list[Path]:
    """Groups of 2, of :data:`LONG` and of 2 frames, so that the last border needs nothing of the first."""
    folder = made_once("long-groups", _make_long_groups)
    return [folder / f"{first}.sgs" for first, _ in RANGES]


def _make_long_groups(folder: Path) -> None:
    header, path = made().header, folder / "track"
    base = GroupBase.read(header)
    source = open_for(base.header, CAPTURE, frames=LONG_FRAMES)
    with closing(track_capture(path, source, base, OPTIONS, quickest_backend())) as frames:
        assert sum(1 for _ in frames) > 0
    of_track = Made(header, path, [])
    for first, end in RANGES:
        fit(folder / f"{first}.sgs", task(of_track, first, end=end), stop_after=LONG_FRAMES)


@pytest.fixture
def fading_in_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seam_blend, "FADE_FRAMES", 1)
    monkeypatch.setattr(join, "OWN_FRAMES", LONG)


@pytest.mark.usefixtures("fading_in_one_frame")
def test_workers_give_the_bytes_of_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(join, "LocalEngine", lambda slots: InlineEngine())
    found = []
    for workers in (1, 2):
        path, borders = tmp_path / f"{workers}.sgs", list[Border]()
        backend = quickest_backend()
        count = join_segments(long_groups(), path, backend=backend, workers=workers, on_border=borders.append)
        assert count == LONG_FRAMES
        assert [border.frame for border in borders] == [*BORDERS]
        assert borders[0].blended > 0
        found.append((path.read_bytes(), borders))
    assert found[1] == found[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.sgs", "2.sgs"]


@pytest.mark.usefixtures("fading_in_one_frame")
def test_a_worker_that_fails_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(paths: list[Path], output: Path, *, device: str) -> Task:
        return Task(output.name, (PYTHON, "-c", "raise SystemExit('no room')"), str(output))

    monkeypatch.setattr(join, "run_task", failing)
    with pytest.raises(TaskError, match="no room"):
        join_segments(long_groups(), tmp_path / "a.sgs", backend=quickest_backend(), workers=2)
    assert not [*tmp_path.iterdir()]


def test_no_worker_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="0 workers"):
        join_segments(made().segments, tmp_path / "a.sgs", backend=quickest_backend(), workers=0)


@given(st.lists(st.integers(1, 2 * OWN_FRAMES), min_size=1, max_size=60), st.integers(1, 9))
def test_runs_have_every_group_but_the_first_once_and_begin_after_long_ones(lengths: list[int], workers: int) -> None:
    runs = runs_of(lengths, workers=workers)
    assert [number for run in runs for number in run] == [*range(1, len(lengths))]
    assert all(lengths[run.start - 1] >= OWN_FRAMES for run in runs[1:])
    if min(lengths) >= OWN_FRAMES:
        assert max(map(len, runs), default=0) <= MAX_GROUPS
        assert len(runs) >= min(workers, len(lengths) - 1) // 2
