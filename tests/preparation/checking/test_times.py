# SPDX-License-Identifier: Apache-2.0
"""Whether pictures of one frame are of one moment, and what is said of it."""

from dataclasses import replace

import pytest

from structgstream.preparation.checking.times import MIN_FRAMES, measure_times, time_findings
from structgstream.preparation.synchronization import SynchronizationCheck
from tests.support.memory_captures import MemoryCapture
from tests.support.planes import room_frame, room_rig
from tests.support.takes import MadeSource, ring

PERIOD = 1 / 30


def measured(*, off: tuple[str, ...] = (), sigma: float = 1e-4, **late: float) -> SynchronizationCheck:
    return SynchronizationCheck(late, dict.fromkeys(late, sigma), off, (), PERIOD)


def test_a_capture_too_short_to_tell() -> None:
    rig = room_rig(3)
    assert measure_times(MemoryCapture(rig, [room_frame(rig)] * (MIN_FRAMES - 1))) is None
    assert time_findings(None) == []


@pytest.mark.parametrize(
    ("late", "severity", "said"),
    [
        (0.001, None, ""),
        (0.0049, None, ""),
        (0.0051, "warning", "is 5.1 ms (0.15 frames) late: less than a frame, which choosing frames cannot mend"),
        (-0.0151, "warning", "is 15.1 ms (0.45 frames) early: less than a frame"),
        (0.0210, "error", "is 21.0 ms (0.63 frames) late; synchronise again, or correct its clock in capture.json"),
        (-0.1, "error", "is 100.0 ms (3.00 frames) early; synchronise again"),
    ],
)
def test_how_late_is_how_bad(late: float, severity: str | None, said: str) -> None:
    findings = time_findings(measured(off=("b",), a=0.0, b=late))
    assert [finding.severity for finding in findings] == ([] if severity is None else [severity])
    assert all(said in finding.sentence and finding.cameras == ("b",) for finding in findings)


def test_less_than_chance_is_nothing() -> None:
    assert time_findings(measured(off=("b",), sigma=0.01, a=0.0, b=0.029)) == []
    assert len(time_findings(measured(off=("b",), sigma=0.01, a=0.0, b=0.031))) == 1


def test_a_little_is_told_of_those_that_are_off_alone() -> None:
    assert time_findings(measured(a=0.0, b=0.007)) == []
    assert len(time_findings(measured(a=0.0, b=0.1))) == 1


def test_what_cannot_be_told_is_a_note() -> None:
    unknown = SynchronizationCheck({}, {}, (), ("a", "b"), PERIOD)
    (finding,) = time_findings(unknown)
    assert (finding.severity, finding.sentence) == ("note", unknown.message)


def test_balls_that_fly_tell_which_camera_is_late() -> None:
    cameras = ring(4)
    source = MadeSource(_rig(cameras), {"cam2": 2 * PERIOD})
    findings = time_findings(measure_times(source))
    assert [(finding.severity, finding.cameras) for finding in findings] == [("error", ("cam2",))]


def _rig(cameras):
    from structgstream.cameras import CameraRig

    return CameraRig(cameras)


def test_what_may_be_less_than_half_a_frame_is_no_error() -> None:
    """26.4 ms (5.1 ms): another choice of frames would mend it or make it worse."""
    (finding,) = time_findings(measured(off=("b",), sigma=0.0051, a=0.0, b=0.0264))
    assert finding.severity == "warning"
    (finding,) = time_findings(measured(off=("b",), sigma=0.0045, a=0.0, b=0.0264))
    assert finding.severity == "error"


def test_pictures_between_those_of_the_others_are_one_warning() -> None:
    check = replace(measured(a=0.0, b=0.001, c=0.0), apart_seconds={"a": 0.0, "b": -0.0167, "c": 0.0174})
    (finding,) = time_findings(check)
    assert (finding.severity, finding.cameras) == ("warning", ("b", "c"))
    assert "those of 'c' 17.4 ms (0.52 frames) too late: less than a frame" in finding.sentence
    unknown = replace(SynchronizationCheck({}, {}, (), ("a", "b"), PERIOD), apart_seconds={"a": 0.0, "b": 0.01})
    assert [finding.severity for finding in time_findings(unknown)] == ["warning", "note"]
