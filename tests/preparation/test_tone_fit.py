# SPDX-License-Identifier: Apache-2.0
"""The fit of one channel; of whole cameras it is tried in ``test_tone``."""

import numpy as np
import pytest

from structgstream.data.arrays import Floats
from structgstream.data.tone import IDENTITY, basis
from structgstream.preparation.tone_fit import (
    LEAST_SLOPE,
    common_curves,
    curve_towards,
    gain_and_bias,
    slopes,
)

LEVELS = np.linspace(0.03, 0.97, 60)
BENT = np.array([0.02, 0.03, 0.10, 0.30, 0.62, 0.85, 0.95, 0.99])  # controls of a curve of strong contrast


def curve(controls: Floats) -> Floats:
    return basis(LEVELS) @ controls


@pytest.mark.parametrize("free", [slopes(), gain_and_bias()])
def test_no_bias_and_slopes_of_one_are_the_identity(free: Floats) -> None:
    straight = free @ [0.0, *[1.0] * (free.shape[1] - 1)]
    np.testing.assert_allclose(straight, IDENTITY, atol=1e-12)
    np.testing.assert_allclose(curve(straight), LEVELS, atol=1e-12)


def test_parameters_are_a_bias_and_slopes() -> None:
    controls = slopes() @ [0.1, 1, 1, 1, 3, 1, 1, 1]
    rises = np.diff(controls) / np.diff(IDENTITY)
    assert controls[0] == pytest.approx(0.1)
    np.testing.assert_allclose(rises, [1, 1, 1, 3, 1, 1, 1])


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_a_curve_is_found_though_some_samples_are_wrong(wrong: float) -> None:
    generator = np.random.default_rng(0)
    values = generator.uniform(0, 1, 1500)
    targets = basis(values) @ BENT + generator.normal(0, 0.01, 1500)
    spoiled = generator.random(1500) < wrong
    targets[spoiled] = generator.uniform(0, 1, int(spoiled.sum()))
    found = curve_towards(values, targets, free=slopes())
    np.testing.assert_allclose(curve(found), curve(BENT), atol=0.012)


def test_a_straight_curve_stays_straight() -> None:
    generator = np.random.default_rng(0)
    values = generator.uniform(0, 1, 800)
    found = curve_towards(values, 0.7 * values + 0.1, free=gain_and_bias())
    gain, bias = np.polyfit(IDENTITY, found, 1)
    np.testing.assert_allclose(found, gain * IDENTITY + bias, atol=1e-12)
    assert (gain, bias) == (pytest.approx(0.7, abs=0.01), pytest.approx(0.1, abs=0.01))


def test_curves_rise_whatever_the_samples_say() -> None:
    values = np.random.default_rng(0).uniform(0, 1, 500)
    found = curve_towards(values, 0.8 - 0.6 * values, free=slopes())
    assert (np.diff(found) / np.diff(IDENTITY)).min() >= LEAST_SLOPE - 1e-9


def test_tones_that_no_sample_has_go_on_as_their_neighbours() -> None:
    values = np.random.default_rng(0).uniform(0.3, 0.6, 500)
    found = curve_towards(values, values + 0.05, free=slopes())
    np.testing.assert_allclose(curve(found) - LEVELS, 0.05, atol=0.005)


def test_cameras_meet_in_their_mean() -> None:
    """Three cameras with gains 0.8, 1 and 1.2 of what they film: curves undo that, their mean is the identity."""
    generator = np.random.default_rng(0)
    gains = np.array([0.8, 1.0, 1.2])
    light = generator.uniform(0.05, 0.8, 400)
    point, camera = np.repeat(np.arange(400), 3), np.tile(np.arange(3), 400)
    found = common_curves(point, camera, light[point] * gains[camera], free=gain_and_bias())
    np.testing.assert_allclose(found.mean(0), IDENTITY, atol=1e-3)
    shown = np.stack([basis(gain * np.array([0.2, 0.5, 0.7])) @ own for gain, own in zip(gains, found, strict=True)])
    assert np.ptp(shown, axis=0).max() < 0.01
    assert np.ptp(np.outer(gains, [0.2, 0.5, 0.7]), axis=0).max() > 0.2
