# SPDX-License-Identifier: Apache-2.0
"""A group's frames are fitted into a segment, whatever interrupts it: which of them how, and from what."""

import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from structgstream.api import reconstruct
from structgstream.atomic_files import partial_path
from structgstream.errors import CaptureError, ConfigError, OutOfMemoryError, StreamError
from structgstream.groups import unit as method
from structgstream.groups.base import GroupBase
from structgstream.groups.first_frame import GroupStartConfig
from structgstream.groups.segment_file import GroupSoFar, open_segment
from structgstream.groups.unit import CATCH_UP_FRAMES, GroupEntry, GroupMethod, lowered_budget, lowered_start
from structgstream.scene.state import state_of
from structgstream.session.pipeline import Past
from structgstream.session.presets import TINY
from structgstream.session.struct_gstream import FrameZeroContext
from structgstream.training.result import FitResult
from tests.support.backends import quickest_backend
from tests.support.clip_groups import CAPTURE, LENGTH, fit, made, task
from tests.support.rigs import random_scene
from tests.support.small_presets import QUICK


def test_stopped_between_frames_and_within_one_it_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    """Cuts at other bytes: test_segment_file.py."""
    path, whole = tmp_path / "g.sgs", made().segments[1].read_bytes()
    assert fit(path, task(made(), LENGTH), stop_after=1) == 1
    assert not path.exists()
    assert len(open_segment(partial_path(path)).entries) == 1
    end = partial_path(path).stat().st_size
    partial_path(path).write_bytes(whole[: end + 3])
    assert fit(path, task(made(), LENGTH)) == 1
    assert path.read_bytes() == whole


def test_the_group_of_frame_0_is_that_of_any_stream(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    reconstruct(CAPTURE, path, preset=QUICK, scale=0.25, frames=LENGTH, backend=quickest_backend())
    data, found = path.read_bytes(), open_segment(made().segments[0])
    for number in range(LENGTH):
        assert found.record(number) in data


def test_what_does_not_move_keeps_the_bits_of_frame_0() -> None:
    base = GroupBase.read(made().header)
    found = open_segment(made().segments[2])
    scene = GroupSoFar(base, 2 * LENGTH, [found.record(0)]).scene(2 * LENGTH)
    first, then = state_of(base.scene()), state_of(scene)
    still = (first["anchor_positions"] == then["anchor_positions"]).all(1)
    assert 0.3 < still.float().mean() < 1.0
    rows = (first["appearance"] == then["appearance"]).all(1) & still
    assert rows.float().mean() > 0.2


def test_another_group_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    shutil.copy(made().segments[1], path)
    with pytest.raises(ConfigError, match="another track and first and end"):
        fit(path, task(made(), 2 * LENGTH))
    with pytest.raises(ConfigError, match="another options"):
        fit(path, replace(task(made(), LENGTH), start=replace(task(made(), 0).start, iterations=8)))
    assert path.read_bytes() == made().segments[1].read_bytes()
    assert fit(path, task(made(), 2 * LENGTH), overwrite=True, stop_after=1) == 1
    assert open_segment(partial_path(path)).entries[0][0] == 2 * LENGTH


def test_ranges_that_are_none_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    with pytest.raises(ConfigError, match="needs a track"):
        fit(path, replace(task(made(), 2), track=None))
    with pytest.raises(StreamError, match="no start at frame 3"):
        fit(path, task(made(), 3))
    with pytest.raises(CaptureError, match="has 12 frames"):
        fit(path, task(made(), 2, end=13))


FIRST = 6
SCENE = random_scene(5, free=2)
START = GroupStartConfig(births=40)


@dataclass
class Usual:
    """The method of any stream, and the fit of a group's start, which keep what they are asked for."""

    asked: list[tuple[str, Any]] = field(default_factory=list)
    thin: list[str] = field(default_factory=list)
    fails: int = 0

    def __call__(self, config: Any) -> "Usual":
        self.thin.append(config.online.spawn.thin.overflow)
        return self

    def observe(self, frame: Any, before: Any, **options: Any) -> str:
        self.asked.append(("observe", before))
        return "as usual"

    def next(self, past: Any, task: Any) -> Any:
        return self._fit("next", past)

    def start(self, scene: Any, displacements: Any, views: Any, changes: Any, **options: Any) -> Any:
        return self._fit("start", SimpleNamespace(changes=changes, displacements=displacements, **options))

    def _fit(self, kind: str, given: Any) -> Any:
        self.asked.append((kind, given))
        if self.fails:
            self.fails -= 1
            raise OutOfMemoryError("to test")
        return FitResult(SCENE, 1, 30.0, moving=0, counts={"scene cuts": 2})


@pytest.fixture
def usual(monkeypatch: pytest.MonkeyPatch) -> Usual:
    made = Usual()
    monkeypatch.setattr(method, "StructGStream", made)
    monkeypatch.setattr(method, "fit_group_start", made.start)
    monkeypatch.setattr(method, "preprocess", lambda frame, rig, **options: options)
    monkeypatch.setattr(method, "training_views", lambda frame, rig, device: f"views of {frame}")
    return made


def group(*, first: int | None = FIRST) -> GroupMethod:
    rows = torch.arange(21, dtype=torch.float32).reshape(7, 3)
    entry = None if first is None else GroupEntry(first, rows, 0.5 * rows, lambda: "frame 0")  # type: ignore[arg-type]
    return GroupMethod(TINY, START, entry)


def frame_task(index: int) -> Any:
    backend = SimpleNamespace(device=torch.device("cpu"))
    pictures = SimpleNamespace(views=["a", "b"], changes=None)
    frame = SimpleNamespace(index=index)
    return SimpleNamespace(
        frame=frame, pictures=pictures, backend=backend, seed=3, steps={}, on_step=None, rate_scale=0.0
    )


def test_the_first_frame_begins_where_tracking_has_followed_things(usual: Usual) -> None:
    found = group().next(Past(SCENE, FrameZeroContext()), frame_task(FIRST))
    ((kind, given),) = usual.asked
    assert (kind, given.frame_index, given.seed, given.start) == ("start", FIRST, 3, START)
    assert torch.equal(given.displacements, torch.arange(21, dtype=torch.float32).reshape(7, 3))
    assert given.changes == [None, None], "a change for each view"
    assert found.counts == {"scene cuts": 2}


def test_the_second_frame_knows_how_things_have_moved_and_later_ones_are_usual(usual: Usual) -> None:
    made = group()
    for index in (FIRST + 1, FIRST + 2):
        made.next(Past(SCENE, FrameZeroContext()), frame_task(index))
    (_, second), (_, third) = usual.asked
    assert third.before_previous is None
    moved = SCENE.anchors.positions - second.before_previous.anchors.positions
    torch.testing.assert_close(moved, 0.5 * torch.arange(15, dtype=torch.float32).reshape(5, 3))
    assert len(second.before_previous.free) == 0
    assert second.state is SCENE


def test_the_first_frames_catch_up(usual: Usual) -> None:
    made = group()
    for index in range(FIRST, FIRST + CATCH_UP_FRAMES + 2):
        made.next(Past(SCENE, FrameZeroContext()), frame_task(index))
    assert usual.asked[0][1].config.spawn.thin.overflow == "small-clusters"
    assert usual.thin == ["small-clusters"] * (CATCH_UP_FRAMES - 1) + ["none"] * 2


def test_the_first_frame_is_compared_with_frame_0_and_others_with_the_one_before(usual: Usual) -> None:
    made, before = group(), object()
    options: Any = {"rig": None, "backend": frame_task(FIRST).backend}
    found: Any = made.observe(frame_task(FIRST).frame, before, **options)  # type: ignore[arg-type]
    assert (found["before"], found["scene_flow"].enabled) == ("views of frame 0", False)
    assert made.observe(frame_task(FIRST + 1).frame, before, **options) == "as usual"  # type: ignore[arg-type]
    assert usual.asked == [("observe", before)]


@pytest.mark.parametrize("index", [FIRST, FIRST + 2])
def test_short_memory_lowers_the_budget_once_and_is_reported(
    usual: Usual, index: int, caplog: pytest.LogCaptureFixture
) -> None:
    made, usual.fails = group(), 1
    found = made.next(Past(SCENE, FrameZeroContext()), frame_task(index))
    assert found.counts == {"scene cuts": 2, "lowered budgets": 1}
    assert (made.lowered, made.start, made.config.online) == (True, lowered_start(START), lowered_budget(TINY.online))
    assert f"Frame {index}: not enough memory." in caplog.text
    assert made.next(Past(SCENE, FrameZeroContext()), frame_task(index)).counts == {"scene cuts": 2}
    usual.fails = 1
    with pytest.raises(OutOfMemoryError):
        made.next(Past(SCENE, FrameZeroContext()), frame_task(index))
    assert made.start == lowered_start(START)
