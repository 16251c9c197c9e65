# SPDX-License-Identifier: Apache-2.0
"""Whether pictures of one frame are of one moment, and what is said of it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from structgstream.cameras import CameraRig
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.frames import MultiViewFrame
from structgstream.preparation.checking.times import SynchronizationCheck, check_synchronization, time_findings
from tests.support.takes import MadeSource, ring

PERIOD = 1 / 30
RIG = CameraRig(ring(4))


def measured(*, off: tuple[str, ...] = (), sigma: float = 1e-4, **late: float) -> SynchronizationCheck:
    return SynchronizationCheck(late, dict.fromkeys(late, sigma), off, (), PERIOD)


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


@pytest.mark.parametrize(
    ("off", "sigma", "late", "severities"),
    [
        (("b",), 0.01, 0.029, []),  # less than chance
        (("b",), 0.01, 0.031, ["warning"]),
        ((), 1e-4, 0.007, []),  # a little is reported of those that are off alone
        ((), 1e-4, 0.1, ["error"]),
        (("b",), 0.0051, 0.0264, ["warning"]),  # maybe less than half a frame: other frames would mend it or harm
        (("b",), 0.0045, 0.0264, ["error"]),
    ],
)
def test_chance_and_what_is_off_decide(off: tuple[str, ...], sigma: float, late: float, severities: list[str]) -> None:
    findings = time_findings(measured(off=off, sigma=sigma, a=0.0, b=late))
    assert [finding.severity for finding in findings] == severities


def test_pictures_between_those_of_the_others_are_one_warning() -> None:
    check = replace(measured(a=0.0, b=0.001, c=0.0), apart_seconds={"a": 0.0, "b": -0.0167, "c": 0.0174})
    (finding,) = time_findings(check)
    assert (finding.severity, finding.cameras) == ("warning", ("b", "c"))
    assert "those of 'c' 17.4 ms (0.52 frames) too late: less than a frame" in finding.sentence
    unknown = replace(SynchronizationCheck({}, {}, (), ("a", "b"), PERIOD), apart_seconds={"a": 0.0, "b": 0.01})
    assert [finding.severity for finding in time_findings(unknown)] == ["warning", "note"]


def test_a_synchronous_capture() -> None:
    check = check_synchronization(MadeSource(RIG, {}))
    assert check.conclusive
    assert not check.off
    assert not check.undecided
    assert max(abs(late) for late in check.late_seconds.values()) < 0.15 / 30
    assert time_findings(check) == []


@pytest.mark.parametrize("frames", [1.0, -2.0, 0.5])
def test_the_camera_that_is_off_is_named(frames: float) -> None:
    check = check_synchronization(MadeSource(RIG, {"cam2": frames / 30}))
    assert check.off == ("cam2",)
    assert check.late_seconds["cam2"] == pytest.approx(frames / 30, abs=0.2 / 30)
    assert abs(check.late_seconds["cam2"] - frames / 30) < 3 * check.uncertainty_seconds["cam2"]
    severity = "error" if abs(frames) >= 1 else "warning"
    assert [(finding.severity, finding.cameras) for finding in time_findings(check)] == [(severity, ("cam2",))]


def test_without_motion_it_cannot_be_reported() -> None:
    check = check_synchronization(MadeSource(RIG, {}, still=True))
    assert not check.conclusive
    assert check.undecided == tuple(RIG)
    (finding,) = time_findings(check)
    assert finding.severity == "note"
    assert "cannot be determined" in finding.sentence


def test_a_camera_in_which_nothing_changes_is_named() -> None:
    class Frozen(MadeSource):
        def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
            first = next(super().frames())
            for frame in super().frames(start):
                yield replace(frame, images={**frame.images, "cam1": first.images["cam1"]})

    (finding,) = time_findings(check_synchronization(Frozen(RIG, {})))
    assert (finding.severity, finding.cameras) == ("warning", ("cam1",))
    assert "Nothing changes in the pictures of camera 'cam1', but in those of most others" in finding.sentence


def test_a_camera_of_another_moment_is_no_silence() -> None:
    """Three seconds late, in a take of less than two: it agrees with nobody."""
    check = check_synchronization(MadeSource(RIG, {"cam1": 3.0}))
    assert check.undecided == ("cam1",)
    (finding,) = time_findings(check)
    assert (finding.severity, finding.cameras) == ("note", ("cam1",))
    assert "cannot be determined whether camera 'cam1' is in step with the others" in finding.sentence


def test_the_bundled_clip_is_synchronous() -> None:
    check = check_synchronization(bundled_clip())
    assert check.conclusive
    assert not check.off


def test_what_time_stamps_say_is_not_late() -> None:
    """Half a frame that is known is no error of the clock; nor is it gone."""
    stated = dict.fromkeys(RIG, np.zeros(40)) | {"cam2": np.full(40, 0.5 / 30)}
    check = check_synchronization(MadeSource(RIG, {"cam2": 0.5 / 30}, apart_seconds=stated))
    assert not check.off
    assert abs(check.late_seconds["cam2"]) < 0.15 / 30
    assert check.late_against_others["cam2"] == pytest.approx(0.5 / 30, abs=0.2 / 30)
    assert check.between == {"cam2": pytest.approx(0.5 / 30)}
    (finding,) = time_findings(check)
    assert "the pictures of 'cam2' lie between those of the others" in finding.sentence


def test_time_stamps_that_are_wrong() -> None:
    stated = dict.fromkeys(RIG, np.zeros(40)) | {"cam2": np.full(40, 0.4 / 30)}
    check = check_synchronization(MadeSource(RIG, {"cam2": 1.4 / 30}, apart_seconds=stated))
    assert check.off == ("cam2",)
    assert check.late_seconds["cam2"] == pytest.approx(1 / 30, abs=0.2 / 30)
