# SPDX-License-Identifier: Apache-2.0
"""Lag and drift of made signals of two clocks."""

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.preparation.synchronization.correlation import Line, Signal, fitted_line

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
