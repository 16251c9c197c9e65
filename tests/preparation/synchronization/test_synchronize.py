# SPDX-License-Identifier: Apache-2.0
"""The choice of the method, what each says when it cannot work, and what choosing nearest frames leaves."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError, ConfigError
from structgstream.preparation.synchronization.synchronize import (
    Synchronization,
    frame_residuals,
    synchronization,
    synchronize,
)
from tests.support.properties import examples
from tests.support.takes import MadeStreams, heard, lenses, ring

VIEWS = ring(3, degrees=60)
CLOCKS = {"cam0": Clock(0.0), "cam1": Clock(0.4), "cam2": Clock(0.15)}
STAMPS = {name: np.arange(75) / 30 for name in VIEWS}
MOVING = MadeStreams(STAMPS, VIEWS, CLOCKS)


def heard_streams(**how: object) -> MadeStreams:
    sounds = heard(CLOCKS, seconds=6.0, **how)  # type: ignore[arg-type]
    return MadeStreams({name: np.arange(180) / 30 for name in VIEWS}, VIEWS, CLOCKS, sounds)


def test_a_table_comes_first(tmp_path: Path) -> None:
    file = tmp_path / "timestamps.csv"
    file.write_text("camera,frame,seconds\ncam0,0,5\ncam1,0,5.5\ncam2,3,5.1\n")
    found = synchronize(heard_streams(), timestamps=file)
    assert (found.method, found.reason) == ("csv", "timestamps.csv states times")
    assert found.clocks["cam1"] == Clock(5.5)


def test_sound_comes_before_motion() -> None:
    found = synchronize(heard_streams())
    assert found.method == "audio"
    for name, clock in CLOCKS.items():
        assert found.clocks[name].offset_seconds == pytest.approx(clock.offset_seconds, abs=1e-4)
        assert 2e-3 < found.uncertainty_seconds[name] < 4e-3  # of a metre that the sound may need longer
    assert any("ms a metre" in warning for warning in found.warnings)


def test_without_sound_motion_decides_and_says_why() -> None:
    found = synchronize(MOVING, cameras=lenses(VIEWS))
    assert found.method == "motion"
    assert "Camera 'cam0' has no sound" in found.reason
    errors = np.array([found.clocks[name].offset_seconds - CLOCKS[name].offset_seconds for name in VIEWS])
    assert np.abs(errors - errors.mean()).max() < 0.2 / 30
    # cam2 is 4.5 frames from cam0, which choosing frames cannot mend.
    assert any("off the common instants" in warning for warning in found.warnings)


def test_stamps_only_when_asked_for() -> None:
    texts = {name: {"timecode": f"10:00:0{index}:00"} for index, name in enumerate(VIEWS)}
    streams = MadeStreams({name: np.arange(150) / 30 for name in VIEWS}, texts=texts)
    found = synchronize(streams, method="stamps")
    assert found.clocks["cam2"].offset_seconds == pytest.approx(2)
    with pytest.raises(CaptureError, match="share no clock"):
        synchronize(MadeStreams(STAMPS), method="stamps")


def test_cameras_that_one_signal_started() -> None:
    found = synchronize(MadeStreams(STAMPS), method="none")
    assert all(clock == Clock() for clock in found.clocks.values())


def test_problems_are_one_sentence_with_the_camera() -> None:
    still = MadeStreams(STAMPS, VIEWS, CLOCKS, still=frozenset({"cam1"}))
    with pytest.raises(CaptureError, match=r"^Too little moves in the pictures of 'cam1' .* move in the first 60 s"):
        synchronize(still, method="motion", cameras=lenses(VIEWS))
    with pytest.raises(CaptureError, match=r"Too little moves .* Nor can sound be used: Camera 'cam0' has no sound"):
        synchronize(still, cameras=lenses(VIEWS))
    named = {"cam. 0; left (top)" if name == "cam0" else name: view for name, view in VIEWS.items()}
    stamps = dict.fromkeys(named, STAMPS["cam0"])
    still = MadeStreams(stamps, named, dict(zip(named, CLOCKS.values(), strict=True)), still=frozenset({"cam1"}))
    with pytest.raises(CaptureError, match=r"Nor can sound be used: Camera 'cam\. 0; left \(top\)' has no sound\.$"):
        synchronize(still, cameras=lenses(named))
    mute = heard_streams()
    mute = MadeStreams(mute.own_stamps, VIEWS, CLOCKS, {name: mute.sounds[name] for name in ("cam0", "cam2")})
    with pytest.raises(CaptureError, match=r"^Camera 'cam1' has no sound; synchronise by motion or timestamps.csv"):
        synchronize(mute, method="audio")
    other = heard({"cam1": Clock()}, seconds=6.0, seed=8)
    strange = MadeStreams(mute.own_stamps, VIEWS, CLOCKS, {**mute.sounds, **other})
    with pytest.raises(CaptureError, match=r"^The sound of 'cam1' has nothing in common with that of 'cam0'"):
        synchronize(strange, method="audio")
    with pytest.raises(CaptureError, match=r"^Camera 'cam1' has no frames"):
        synchronize(MadeStreams({**STAMPS, "cam1": np.zeros(0)}))


def test_options_that_cannot_be() -> None:
    with pytest.raises(ConfigError, match="must be one of auto, csv"):
        synchronize(MOVING, method="guess")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"needs timestamps.csv"):
        synchronize(MOVING, method="csv")


TIMES = np.arange(120) / 30


def result(*offsets: float, sigma: float = 1e-4) -> Synchronization:
    names = [f"cam{index}" for index in range(len(offsets))]
    clocks = {name: Clock(offset) for name, offset in zip(names, offsets)}
    stamps = dict.fromkeys(names, TIMES)
    return synchronization(stamps, clocks, dict.fromkeys(names, sigma), method="audio", reason="a test")


@given(offsets=st.lists(st.floats(-1, 1), min_size=2, max_size=6))
@examples(60)
def test_nearest_frames_are_within_half_a_period(offsets: list[float]) -> None:
    left = [*frame_residuals({str(index): TIMES + offset for index, offset in enumerate(offsets)}).values()]
    assert np.abs(left).max() <= 1 / 60 + 1e-9
    # Differences between cameras remain, up to whole frames.
    rest = (left[1] - left[0] - (offsets[1] - offsets[0])) * 30
    assert rest == pytest.approx(round(rest), abs=1e-6)


def test_whole_frames_leave_nothing() -> None:
    assert not result(0.0, 5 / 30, -12 / 30).warnings


def test_a_vague_clock_is_warned_of() -> None:
    assert any("may be wrong by one" in warning for warning in result(0.0, 0.1, sigma=0.02).warnings)


def test_drift_and_other_rates_count() -> None:
    common = {"a": TIMES, "b": np.arange(240) / 60 + 2e-3, "c": TIMES * (1 + 1e-3)}
    left = frame_residuals(common)
    assert abs(left["b"] - left["a"]) == pytest.approx(2e-3, abs=5e-3)
    assert max(abs(left["a"]), abs(left["c"])) > 1.5e-3


def test_an_absent_frame_is_not_late() -> None:
    left = frame_residuals({"a": TIMES, "b": np.delete(TIMES, [40, 41, 42])})
    assert left["b"] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("rate", [30.0, 30.005, 24.0])
def test_jitter_is_not_taken_for_another_rate(rate: float) -> None:
    """Steps of jittered stamps have a median that is not their mean; the instants must not leave the frames."""
    random = np.random.default_rng(7)
    jitter = 4e-3
    common = {
        name: (np.arange(1800) + offset) / rate + jitter * (random.beta(0.4, 1.6, 1800) - 0.2)
        for name, offset in (("a", 0), ("b", 3), ("c", -2))
    }
    medians = [float(np.median(np.diff(times))) * rate for times in common.values()]
    assert max(abs(median - 1) for median in medians) * 1800 / rate > 2 * jitter  # the median would drift that far
    assert all(abs(late) < 1.5 * jitter for late in frame_residuals(common).values())
