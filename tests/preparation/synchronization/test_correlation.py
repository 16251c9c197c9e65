# SPDX-License-Identifier: Apache-2.0
"""Lags of made signals.

Lag and drift of made signals of two clocks.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from structgstream.preparation.synchronization.correlation import (
    Line,
    Signal,
    best_lag,
    chance_deviation,
    fitted_line,
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


FINE = 1 / 600
LAG = 0.237


def scene(*, events: bool, seed: int, seconds: float = 20.0, channels: int = 12) -> NDArray[np.float64]:
    """What happens ``[T, B]`` at steps of ``FINE``, of which frames show sums: motion that swells and fades, or events
    of one instant."""
    generator = np.random.default_rng(seed)
    count = round(seconds / FINE)
    if events:
        return (generator.random((count, channels)) < 2 * FINE).astype(float)
    knots = np.arange(0, seconds + 0.2, 0.12)
    values = generator.normal(size=(channels, len(knots))) * (generator.random((channels, len(knots))) < 0.6)
    return np.stack([np.maximum(np.interp(np.arange(count) * FINE, knots, own), 0) for own in values], axis=1)


def filmed(
    happens: NDArray[np.float64], offset: float, rate: float, *, seconds: float, noise: float, seed: int
) -> Signal:
    """A camera's signal: what happened in each thirtieth of a second of its clock, ``common = offset + rate * own``."""
    own = np.arange(round(seconds * 30) + 1) / 30
    totals = np.concatenate([np.zeros((1, happens.shape[1])), np.cumsum(happens, axis=0)])
    at = (offset + rate * own) / FINE
    sums = np.stack([np.interp(at, np.arange(len(totals)), column) for column in totals.T], axis=1)
    values = np.diff(sums, axis=0)
    values = values + noise * values.std() * np.random.default_rng(seed).normal(size=values.shape)
    return Signal(values, 1 / 60, 1 / 30)


def line_of(rate: float, *, events: bool = False, seconds: float = 13.0, noise: float = 0.1, seed: int = 0) -> Line:
    """The second clock began ``LAG`` before the first, which began at 1 s, and runs by ``rate``."""
    happens = scene(events=events, seed=seed)
    one = filmed(happens, 1.0, 1.0, seconds=seconds, noise=noise, seed=100 + seed)
    other = filmed(happens, 1.0 - LAG, rate, seconds=seconds, noise=noise, seed=200 + seed)
    found = fitted_line(one, other, expected_seconds=LAG + 0.02, edges=np.linspace(0, seconds, 13))
    assert found is not None
    return found


@pytest.mark.parametrize("rate", [1.0, 1 + 1e-3, 1 - 4e-4])
def test_lag_and_drift_of_thirteen_seconds(rate: float) -> None:
    line = line_of(rate)
    assert line.rate == pytest.approx(1 / rate - 1, abs=1e-4)
    assert line.lag_seconds == pytest.approx((line.middle + LAG) / rate - line.middle, abs=1e-3)


@pytest.mark.parametrize("events", [False, True])
def test_the_jackknife_tells_the_error(events: bool) -> None:
    """Errors over stated ones over many takes; events, in which two frames tell little, have larger ones."""
    lags, rates = [], []
    for seed in range(25):
        line = line_of(1 + 5e-4, events=events, noise=0.3, seed=seed)
        lags.append((line.lag_seconds - (line.middle + LAG) / (1 + 5e-4) + line.middle) / line.lag_sigma)
        assert line.rate is not None
        rates.append((line.rate - 1 / (1 + 5e-4) + 1) / line.rate_sigma)
    for scores in (lags, rates):
        assert 0.4 < np.mean(np.square(scores)) < 2.5


def test_noise_tells_no_drift() -> None:
    generator = np.random.default_rng(0)
    signals = [Signal(generator.normal(size=(390, 4)), 0.0, 1 / 30) for _ in range(2)]
    lines = [fitted_line(*signals, expected_seconds=lag, edges=np.linspace(0, 13, 13)) for lag in (-0.5, 0.0, 0.5)]
    assert all(line is None or line.rate is None or line.rate_sigma > 2e-4 for line in lines)


def test_too_little_in_common_is_no_line() -> None:
    happens = scene(events=False, seed=0)
    one = filmed(happens, 1.0, 1.0, seconds=8.0, noise=0.0, seed=0)
    edges = np.linspace(0, 8, 9)
    assert fitted_line(one, one, expected_seconds=-7.9, edges=edges) is None
    still = Signal(np.zeros_like(one.values), one.start, one.step)
    assert fitted_line(one, still, expected_seconds=0.0, edges=edges) is None
