# SPDX-License-Identifier: Apache-2.0
"""Sessions that begin other periods: by time, and where the scene is another one; resumed, the bytes are the same."""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import pytest

from structgstream.codec.container.records import RecordType, scan_records
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import MemorySink
from structgstream.frames import MultiViewFrame
from structgstream.session import struct_gstream as method
from structgstream.session.loop import FrameReport
from structgstream.session.periods import PeriodConfig
from structgstream.session.presets import StreamConfig, to_json
from structgstream.session.rate_control import RateConfig
from tests.session.test_session_compact import CONFIG as COMPACT_CONFIG
from tests.session.test_session_compact import WORLD
from tests.support.memory_captures import MemoryCapture
from tests.support.sessions import resume_in, run_session

FRAMES = 8
CHANGE = 3
"""From this frame on the cameras see other colours."""
INITIAL = replace(COMPACT_CONFIG.initial, iterations=60, schedule_iterations=60, coarse_iterations=20)
BASE = replace(COMPACT_CONFIG, initial=INITIAL)
SCHEDULED = replace(
    BASE, period=PeriodConfig(seconds=4 / 30, start="scene", share=0.3), rate=RateConfig(target_mbits=0.5)
)
BY_RESIDUAL = replace(BASE, period=PeriodConfig(residual=1.3, frames=2, start="scene", share=0.5))
ANEW = replace(BASE, period=PeriodConfig(residual=1.3, frames=2))
CONFIGS = {"scheduled": (SCHEDULED, [0, 4]), "residual": (BY_RESIDUAL, [0, 6]), "points": (ANEW, [0, 6])}


def frames() -> list[MultiViewFrame]:
    """The moving world, there and back, whose colours are inverted from frame :data:`CHANGE` on."""
    found = []
    for index in range(FRAMES):
        shown = WORLD.frames[[0, 1, 2, 3, 2, 1, 0, 1][index]]
        images = shown.images if index < CHANGE else {name: 255 - image for name, image in shown.images.items()}
        found.append(MultiViewFrame(index, index / 30.0, images))
    return found


def capture(length: int = FRAMES) -> MemoryCapture:
    return MemoryCapture(WORLD.rig, frames()[:length], points=WORLD.scene.anchors.positions.numpy())


def run(sink, config: StreamConfig, *, resumed=None, length: int = FRAMES) -> list[FrameReport]:
    return run_session(capture(length), sink, config, resumed=resumed)


@cache
def whole(case: str) -> tuple[bytes, list[FrameReport]]:
    """The stream and the reports."""
    reports = run(sink := MemorySink(), CONFIGS[case][0])
    return sink.data, reports


@pytest.mark.parametrize("case", CONFIGS)
def test_periods_begin_where_they_should_and_say_why(case: str) -> None:
    data, reports = whole(case)
    reader = StreamReader(data)
    firsts = CONFIGS[case][1]
    assert [period.first_frame for period in reader.periods] == firsts
    assert [report.index for report in reports if report.begins] == firsts[1:]
    why = reports[firsts[1]].begins or ""
    assert why.startswith("after 0.133 s" if case == "scheduled" else "residual ")
    assert reader.header.periods
    assert reader.header_of(FRAMES - 1).config == reader.header.config == to_json(CONFIGS[case][0])


@pytest.mark.parametrize("case", CONFIGS)
def test_stopped_it_goes_on_to_the_same_bytes(case: str, tmp_path: Path) -> None:
    """Stopped before the second period, in its init record, and after its first frame: a resumed run has what a reader
    sees, so the uninterrupted one started from that, too."""
    data = whole(case)[0]
    records = [record for record in scan_records(data) if record.type != RecordType.INDEX]
    (second,) = (number for number, record in enumerate(records) if number and record.type == RecordType.INIT)
    path = tmp_path / "a.sgs"
    cuts = (records[second].offset + 100, records[second - 1].offset, records[second + 1].end)
    for cut in cuts if case == "scheduled" else cuts[:1]:
        resume_in(path, data[:cut], partial(run, config=CONFIGS[case][0]))
        assert path.read_bytes() == data, cut


def test_without_periods_nothing_is_measured_and_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(method, "mean_residual", lambda *_, **__: pytest.fail("measured"))
    run(sink := MemorySink(), COMPACT_CONFIG, length=2)
    assert {record.period for record in scan_records(sink.data)} == {0}
    assert "period" not in StreamReader(sink.data).header.config
