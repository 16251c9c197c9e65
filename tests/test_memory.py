# SPDX-License-Identifier: Apache-2.0
"""Peaks by stage, and a long run whose memory must not grow."""

import ctypes
import gc
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream import memory
from structgstream.cameras import CameraRig
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.data.source import Prefetch
from structgstream.frames import MultiViewFrame
from structgstream.memory import PeakKind, PeakMeter, resident_bytes
from structgstream.session.loop import Session
from structgstream.session.struct_gstream import stream_pipeline
from tests.support.backends import quickest_backend
from tests.support.small_presets import TINY_RIG
from tests.support.worlds import World, moving_world

FRAMES = 200
SETTLED = 60  # caches, pools of allocators and the free set are full by then
# A kept packet is 15 kB and a kept set of pictures 28 kB a frame: either is more than 2.1 MB over 140 frames.
MAX_GROWTH_BYTES = 2 * 2**20
MAX_NEW_OBJECTS = 50
MEGABYTES_64 = 63 * 2**20

needs_resident = pytest.mark.skipif(resident_bytes() is None, reason="the system does not tell the resident size")
CPU = torch.device("cpu")


def spend(meter: PeakMeter, stage: str, size: int) -> None:
    """A stage that holds ``size`` bytes for a moment."""
    pages = np.ones(size, np.uint8)
    assert pages[-1] == 1
    del pages
    meter.end(stage)


STAGES = """
import json, numpy, sys
from types import SimpleNamespace
sys.modules["torch"] = SimpleNamespace(device=object)  # of the processor, and loaded in seconds
from structgstream.memory import PeakMeter
meter = PeakMeter(SimpleNamespace(type="cpu"))
for stage, size in (("small", 1), ("large", LARGE), ("small again", 1)):
    assert numpy.ones(size, numpy.uint8)[-1] == 1
    meter.end(stage)
print(json.dumps([meter.kind, meter.process_bytes, meter.device_bytes]))
"""


def test_each_stage_has_its_own_peak() -> None:
    if PeakMeter(CPU).kind is not PeakKind.STAGE:
        pytest.skip("the system does not let a process set back its mark")
    large = 4 * MEGABYTES_64
    # In a process of its own: in this one, what earlier tests left may be given back in the midst of it.
    script = STAGES.replace("LARGE", str(large))
    printed = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    kind, peaks, device_bytes = json.loads(printed)
    assert [*peaks] == ["small", "large", "small again"]
    assert peaks["large"] > peaks["small"] + 0.9 * large
    assert peaks["small again"] < peaks["large"] - 0.9 * large
    assert kind == PeakKind.STAGE
    assert not device_bytes


@pytest.mark.parametrize("missing", ["_CLEAR", "_STATUS"])
def test_where_the_mark_cannot_be_set_back_it_only_rises(
    missing: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(memory, missing, tmp_path / "no folder" / "nothing")
    meter = PeakMeter(CPU)
    spend(meter, "large", MEGABYTES_64)
    spend(meter, "small", 1)
    assert meter.kind is PeakKind.PROCESS
    assert meter.process_bytes["small"] >= meter.process_bytes["large"] > MEGABYTES_64


def test_a_mark_that_can_no_longer_be_set_back_is_said_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    meter = PeakMeter(CPU)
    if meter.kind is not PeakKind.STAGE:
        pytest.skip("the system does not let a process set back its mark")
    meter.end("first")
    monkeypatch.setattr(memory, "_CLEAR", tmp_path / "no folder" / "nothing")
    meter.end("second")
    meter.end("third")
    assert meter.kind is PeakKind.PROCESS
    assert [*meter.process_bytes] == ["first", "second", "third"]


def test_a_gpu_is_measured_beside_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The two functions of torch stand in for a GPU: a mark that an allocation raises and a reset takes back."""
    mark = {"bytes": 700}
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: mark.update(bytes=10))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: mark["bytes"])
    meter = PeakMeter(torch.device("cuda"))
    mark["bytes"] = 500
    meter.end("fit")
    meter.end("store")
    assert meter.device_bytes == {"fit": 500, "store": 10}


@dataclass(frozen=True)
class Endless:
    """Two pictures in turn, each time as new arrays, as a decoder hands them over."""

    world: World
    frame_count: int
    fps: float = 30.0
    name: str = "endless"
    points: np.ndarray | None = None

    @property
    def rig(self) -> CameraRig:
        return self.world.rig

    def __len__(self) -> int:
        return self.frame_count

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for i in range(start, self.frame_count):
            images = self.world.frames[i % 2].images
            yield MultiViewFrame(i, i / self.fps, {name: image.copy() for name, image in images.items()})


def held() -> tuple[int, int]:
    """Resident bytes and the number of Python objects, once what is unreachable has gone back to the system."""
    gc.collect()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # What earlier tests freed may lie about otherwise.
        trim(0)
    resident = resident_bytes()
    assert resident is not None
    return resident, len(gc.get_objects())


def check_growth(before: tuple[int, int], after: tuple[int, int]) -> None:
    assert after[0] - before[0] < MAX_GROWTH_BYTES, f"{before[0]:,} bytes grew to {after[0]:,}"
    assert after[1] - before[1] < MAX_NEW_OBJECTS, f"{before[1]:,} objects grew to {after[1]:,}"


@needs_resident
def test_a_long_run_and_reading_it_back_hold_no_more_at_the_end_than_at_the_beginning(tmp_path: Path) -> None:
    """200 frames with the real fit, decoded ahead as the command does; scenes are as large as ``max_free`` allows."""
    points = np.random.default_rng(0).normal(size=(60, 3)) * 0.4
    backend = quickest_backend()
    last = FRAMES - 1
    source = Endless(moving_world(2, cameras=3, width=64, height=48), last + 1, points=points)
    config = replace(
        TINY_RIG,
        initial=replace(TINY_RIG.initial, iterations=4, schedule_iterations=4, coarse_iterations=2, voxel_size=0.3),
        online=replace(
            TINY_RIG.online, iterations=1, patching=replace(TINY_RIG.online.patching, iteration=1, max_free=100)
        ),
    )
    path = tmp_path / "long.sgs"
    measured: dict[int, tuple[int, int]] = {}
    frees = []
    for report in Session(Prefetch(source), FileSink(path), stream_pipeline(config), backend).run():
        if report.index in (SETTLED, last):
            measured[report.index] = held()
            frees.append(report.free)
    check_growth(measured[SETTLED], measured[last])
    assert frees == [100, 100]  # a scene that grew would be no measure of what the loop keeps
    size = path.stat().st_size
    assert size > 1.4 * MAX_GROWTH_BYTES  # so that a reader that keeps the file is seen
    closed = held()
    with open_stream(path) as reader:
        for info, _ in reader.scenes():
            if info.index in (SETTLED, last):
                measured[info.index] = held()
        assert len(reader) == last + 1
    check_growth(measured[SETTLED], measured[last])
    assert measured[last][0] - closed[0] < MAX_GROWTH_BYTES
