# SPDX-License-Identifier: Apache-2.0
"""A group's frames: which of them are fitted how, from what, and what happens once when memory is short."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from structgstream.errors import OutOfMemoryError
from structgstream.groups import unit as method
from structgstream.groups.first_frame import GroupStartConfig
from structgstream.groups.unit import (
    CATCH_UP_FRAMES,
    GroupEntry,
    GroupMethod,
    lowered_budget,
    lowered_start,
)
from structgstream.session.pipeline import Past
from structgstream.session.presets import TINY
from structgstream.session.struct_gstream import FrameZeroContext
from structgstream.training.result import FitResult
from tests.support.rigs import random_scene

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


def task(index: int) -> Any:
    backend = SimpleNamespace(device=torch.device("cpu"))
    pictures = SimpleNamespace(views=["a", "b"], changes=None)
    frame = SimpleNamespace(index=index)
    return SimpleNamespace(
        frame=frame, pictures=pictures, backend=backend, seed=3, steps={}, on_step=None, pressure=0.0
    )


def test_the_first_frame_begins_where_tracking_has_followed_things(usual: Usual) -> None:
    found = group().next(Past(SCENE, FrameZeroContext()), task(FIRST))
    ((kind, given),) = usual.asked
    assert (kind, given.frame_index, given.seed, given.start) == ("start", FIRST, 3, START)
    assert torch.equal(given.displacements, torch.arange(21, dtype=torch.float32).reshape(7, 3))
    assert given.changes == [None, None], "a change for each view"
    assert found.counts == {"scene cuts": 2}


def test_the_second_frame_knows_how_things_have_moved_and_later_ones_are_usual(usual: Usual) -> None:
    made = group()
    for index in (FIRST + 1, FIRST + 2):
        made.next(Past(SCENE, FrameZeroContext()), task(index))
    (_, second), (_, third) = usual.asked
    assert third.older is None
    moved = SCENE.anchors.positions - second.older.anchors.positions
    torch.testing.assert_close(moved, 0.5 * torch.arange(15, dtype=torch.float32).reshape(5, 3))
    assert len(second.older.free) == 0
    assert second.state is SCENE


def test_the_first_frames_catch_up(usual: Usual) -> None:
    made = group()
    for index in range(FIRST, FIRST + CATCH_UP_FRAMES + 2):
        made.next(Past(SCENE, FrameZeroContext()), task(index))
    assert usual.asked[0][1].config.spawn.thin.overflow == "small-clusters"
    assert usual.thin == ["small-clusters"] * (CATCH_UP_FRAMES - 1) + ["none"] * 2


def test_the_first_frame_is_compared_with_frame_0_and_others_with_the_one_before(usual: Usual) -> None:
    made, before = group(), object()
    options: Any = {"rig": None, "backend": task(FIRST).backend}
    found: Any = made.observe(task(FIRST).frame, before, **options)  # type: ignore[arg-type]
    assert (found["before"], found["scene_flow"].enabled) == ("views of frame 0", False)
    assert made.observe(task(FIRST + 1).frame, before, **options) == "as usual"  # type: ignore[arg-type]
    assert usual.asked == [("observe", before)]


@pytest.mark.parametrize("index", [FIRST, FIRST + 2])
def test_short_memory_lowers_the_budget_once_and_is_reported(
    usual: Usual, index: int, caplog: pytest.LogCaptureFixture
) -> None:
    made, usual.fails = group(), 1
    found = made.next(Past(SCENE, FrameZeroContext()), task(index))
    assert found.counts == {"scene cuts": 2, "lowered budgets": 1}
    assert (made.lowered, made.start, made.config.online) == (True, lowered_start(START), lowered_budget(TINY.online))
    assert f"Frame {index}: not enough memory." in caplog.text
    assert made.next(Past(SCENE, FrameZeroContext()), task(index)).counts == {"scene cuts": 2}
    usual.fails = 1
    with pytest.raises(OutOfMemoryError):
        made.next(Past(SCENE, FrameZeroContext()), task(index))
    assert made.start == lowered_start(START)
