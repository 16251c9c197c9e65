# SPDX-License-Identifier: Apache-2.0
"""What remains after choosing nearest frames, and what is warned of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.timeline import Clock
from structgstream.preparation.synchronization.synchronize import Synchronization, frame_residuals, synchronization
from tests.support.properties import examples

STAMPS = np.arange(120) / 30


def result(*offsets: float, sigma: float = 1e-4) -> Synchronization:
    names = [f"cam{index}" for index in range(len(offsets))]
    clocks = {name: Clock(offset) for name, offset in zip(names, offsets)}
    stamps = dict.fromkeys(names, STAMPS)
    return synchronization(stamps, clocks, dict.fromkeys(names, sigma), method="audio", reason="a test")


@given(offsets=st.lists(st.floats(-1, 1), min_size=2, max_size=6))
@examples(60)
def test_nearest_frames_are_within_half_a_period(offsets: list[float]) -> None:
    left = [*frame_residuals({str(index): STAMPS + offset for index, offset in enumerate(offsets)}).values()]
    assert np.abs(left).max() <= 1 / 60 + 1e-9
    # Differences between cameras remain, up to whole frames.
    rest = (left[1] - left[0] - (offsets[1] - offsets[0])) * 30
    assert rest == pytest.approx(round(rest), abs=1e-6)


def test_whole_frames_leave_nothing() -> None:
    assert not result(0.0, 5 / 30, -12 / 30).warnings


def test_a_vague_clock_is_warned_of() -> None:
    assert any("may be wrong by one" in warning for warning in result(0.0, 0.1, sigma=0.02).warnings)


def test_drift_and_other_rates_count() -> None:
    common = {"a": STAMPS, "b": np.arange(240) / 60 + 2e-3, "c": STAMPS * (1 + 1e-3)}
    left = frame_residuals(common)
    assert abs(left["b"] - left["a"]) == pytest.approx(2e-3, abs=5e-3)
    assert max(abs(left["a"]), abs(left["c"])) > 1.5e-3


def test_an_absent_frame_is_not_late() -> None:
    left = frame_residuals({"a": STAMPS, "b": np.delete(STAMPS, [40, 41, 42])})
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
