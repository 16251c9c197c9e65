# SPDX-License-Identifier: Apache-2.0
"""Streams whose frames begin by flow and births: they act, they repeat, and they resume bit for bit."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from structgstream.codec.container.records import scan_records
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import MemorySink
from structgstream.frames import MultiViewFrame
from structgstream.session.loop import FrameReport
from structgstream.session.presets import COMPACT
from structgstream.training.online.config import SpawnRules
from tests.support.memory_captures import MemoryCapture
from tests.support.sessions import resume_in, run_session
from tests.support.small_presets import TINY_RIG
from tests.support.varied import varied
from tests.support.worlds import moving_world

FRAMES = 4
WORLD = moving_world(FRAMES, cameras=6, speed=0.16, movers=40, emerges_at=2, width=128, height=96)
POINTS = WORLD.scene.anchors.positions.numpy().astype(float)
CONFIG = replace(
    COMPACT,
    initial=replace(TINY_RIG.initial, iterations=60, random_background=True),
    online=replace(
        COMPACT.online,
        iterations=6,
        motion=varied(COMPACT.online.motion, REACH_PIXELS=1),
        spawn=varied(COMPACT.online.spawn, RULES=SpawnRules(min_hits=2, residual_threshold=0.2)),
    ),
)


def run(sink, *, resumed=None, pictures: list[MultiViewFrame] = WORLD.frames) -> list[FrameReport]:
    capture = MemoryCapture(WORLD.rig, pictures, points=POINTS)
    return run_session(capture, sink, CONFIG, resumed=resumed)


@cache
def whole() -> tuple[bytes, list[FrameReport]]:
    reports = run(sink := MemorySink())
    return bytes(sink.data), reports


def test_every_part_acts_and_is_counted() -> None:
    counts = [report.counts for report in whole()[1]]
    assert not counts[0]
    assert all(count["displaced"] > 0 for count in counts[1:])
    assert all(count["corrected"] > 0 for count in counts[1:])
    assert [report.iterations for report in whole()[1][1:]] == [12, 12, 12]
    assert not any(count["scene cuts"] or count["views left out"] for count in counts[1:])


def test_interrupted_and_resumed_it_is_the_same_file(tmp_path: Path) -> None:
    """What frame 0 missed, what moved last and the last pictures are all found, after frame 0 and frame 2."""
    data, path = whole()[0], tmp_path / "a.sgs"
    for number in (1, 3):
        resume_in(path, data[: [*scan_records(data)][number].end], run)
        assert path.read_bytes() == data


def spoiled(change, *, frame: int, cameras: int) -> list[MultiViewFrame]:
    """The world, ``cameras`` of its training cameras changed in one frame."""
    names = WORLD.rig.training[:cameras]
    images = dict(WORLD.frames[frame].images)
    images |= {name: change(images[name]) for name in names}
    return [replace(f, images=images) if f.index == frame else f for f in WORLD.frames]


@pytest.mark.parametrize("kind", ["white", "noise", "light"])
def test_bad_pictures_bring_no_flood(kind: str) -> None:
    def change(image: np.ndarray) -> np.ndarray:
        if kind == "white":
            return np.full_like(image, 255)
        if kind == "noise":
            return np.random.default_rng(0).integers(0, 256, image.shape, dtype=np.uint8)
        return np.minimum(image.astype(int) + 80, 255).astype(np.uint8)

    cameras = len(WORLD.rig.training) if kind == "light" else 1
    pictures = spoiled(change, frame=1, cameras=cameras)[: FRAMES if kind == "light" else 3]
    reports = run(sink := MemorySink(), pictures=pictures)
    usual = whole()[1]
    assert len(StreamReader(bytes(sink.data))) == len(pictures), "nothing is lost"
    assert reports[1].free - reports[0].free <= CONFIG.online.spawn.most
    if kind == "light":
        assert [r.counts["scene cuts"] for r in reports[1:]] == [1, 1, 0], "on, and off again"
        assert reports[1].counts["spawned"] == 0
        everything = 40 * (len(WORLD.scene.anchors) + CONFIG.online.spawn.most)
        assert all(r.bytes < everything for r in reports[1:])
        return
    assert reports[1].bytes < 2 * usual[1].bytes
    left_out, absent = [r.counts["views left out"] for r in reports[1:3]], [r.absent for r in reports[1:3]]
    if kind == "white":
        assert (left_out, absent) == ([0, 0], [WORLD.rig.training[:1], ()]), "a blank picture is none"
    else:
        assert (left_out, absent) == ([1, 1], [(), ()]), "blinded, and back again"
