# SPDX-License-Identifier: Apache-2.0
"""Lags of made signals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.preparation.synchronization.correlation import (
    Signal,
    best_lag,
    chance_deviation,
    lag_changes,
    resampled,
)
from tests.support.properties import examples


def smooth(times: np.ndarray, channels: int, seed: int = 0) -> np.ndarray:
    """Values ``[T, B]`` of sums of slow oscillations."""
    generator = np.random.default_rng(seed)
    rates, phases = generator.uniform(2, 25, (12, channels)), generator.uniform(0, 7, (12, channels))
    return np.sin(times[:, None, None] * rates + phases).sum(1)


def signal(start: float, count: int, *, shift: float = 0.0, channels: int = 16, noise: float = 0.1) -> Signal:
    """What begins at ``start`` by a clock that shows ``shift`` more than the common one."""
    times = start + np.arange(count) / 30
    generator = np.random.default_rng(count)
    return Signal(smooth(times - shift, channels) + generator.normal(0, noise, (count, channels)), start, 1 / 30)


@given(shift=st.floats(-1.0, 1.0), start=st.floats(-0.5, 0.5))
@examples(40)
def test_the_lag_is_found_between_samples(shift: float, start: float) -> None:
    lag = best_lag(signal(0.0, 120), signal(start, 150, shift=shift))
    assert lag is not None
    assert lag.seconds == pytest.approx(shift, abs=1e-3)
    assert abs(lag.seconds - shift) < 4 * lag.sigma_seconds
    assert lag.peak > 0.8 > lag.rival


def test_only_lags_within_limits() -> None:
    lag = best_lag(signal(0.0, 120), signal(0.0, 120, shift=0.5), within=(-0.1, 0.1))
    assert lag is None or abs(lag.seconds) <= 0.1 + 1 / 60


def test_a_constant_has_no_lag() -> None:
    assert best_lag(signal(0, 60), Signal(np.ones((60, 16)), 0.0, 1 / 30)) is None


def test_an_overlap_that_is_too_short_has_no_lag() -> None:
    assert best_lag(signal(0, 5), signal(0, 60), min_overlap=8) is None


def test_irregular_stamps_are_resampled() -> None:
    generator = np.random.default_rng(0)
    times = np.arange(90) / 30 + generator.uniform(-0.008, 0.008, 90)
    times.sort()
    irregular = resampled(smooth(times, 16), times, step=1 / 30)
    lag = best_lag(signal(0.0, 120), irregular)
    assert lag is not None
    assert lag.seconds == pytest.approx(0, abs=2e-3)


def test_regular_stamps_are_kept() -> None:
    values = np.random.default_rng(0).normal(size=(50, 3))
    assert resampled(values, 2 + np.arange(50) / 25, step=1 / 25).values is values


def test_a_cut_keeps_its_times() -> None:
    whole = signal(1.0, 60)
    part = whole.cut(1.5, 2.0)
    assert (part.start, part.end) == (pytest.approx(1.5), pytest.approx(2.0))
    assert part.values[0] == pytest.approx(whole.values[15])


def test_chance_of_independent_signals() -> None:
    """The deviation that is stated is that of correlations of many pairs of independent signals."""
    generator = np.random.default_rng(1)
    kernel = np.exp(-np.arange(20) / 5)
    made = [np.convolve(generator.normal(size=420), kernel, "valid")[:400, None] for _ in range(60)]
    found = [float(np.corrcoef(a[:, 0], b[:, 0])[0, 1]) for a, b in zip(made[::2], made[1::2])]
    stated = np.mean([chance_deviation(Signal(a, 0, 1), Signal(b, 0, 1)) for a, b in zip(made[::2], made[1::2])])
    assert np.std(found) == pytest.approx(float(stated), rel=0.4)


def test_the_lag_without_each_part_of_the_take() -> None:
    """In the last third the second signal is late by half a sample more."""
    step = 1 / 30
    first, second, later = (signal(0.0, 120, shift=shift) for shift in (0.0, 0.1, 0.1 + step / 2))
    mixed = Signal(np.concatenate([second.values[:83], later.values[83:]]), 0.0, step)
    lag = best_lag(first, mixed)
    assert lag is not None
    changes = lag_changes(first, mixed, lag.seconds, np.array([0.0, 40, 80, 120]) * step)
    assert changes[2] == pytest.approx(0.1 - lag.seconds, abs=0.05 * step)
    assert changes[0] > 0.05 * step
    assert changes[1] > 0.05 * step
    steady = best_lag(first, second)
    assert steady is not None
    assert np.abs(lag_changes(first, second, steady.seconds, np.array([0.0, 40, 80, 120]) * step)).max() < 0.02 * step
