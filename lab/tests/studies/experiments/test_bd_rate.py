# SPDX-License-Identifier: Apache-2.0
"""Bjontegaard's differences: in closed form, against another implementation of the interpolation, and as a property."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from structgstream.errors import ConfigError
from structgstream_studies.experiments.bd_rate import Points, bd_psnr, bd_rate, psnr_at, rate_at

CURVE = ((4.0, 27.5), (9.0, 29.0), (17.0, 30.2), (40.0, 30.9), (95.0, 31.1))


@st.composite
def curves(draw: st.DrawFn) -> Points:
    """2 to 6 points between 1 and e^4, 28 and 34 dB, at least; rates and qualities rise."""
    count = draw(st.integers(2, 6))
    gaps = st.lists(st.floats(0.05, 1.0), min_size=count - 1, max_size=count - 1)
    rates, qualities = (np.cumsum([0.0, *draw(gaps)]) for _ in range(2))
    return [
        (math.exp(4.0 * rate / rates[-1] + 0.1), 28.0 + 6.0 * quality / qualities[-1])
        for rate, quality in zip(rates, qualities)
    ]


@pytest.mark.parametrize("factor", [0.25, 0.9, 1.0, 3.0])
def test_a_curve_at_so_many_times_the_rate(factor: float) -> None:
    other = [(rate * factor, quality) for rate, quality in CURVE]
    assert bd_rate(other, CURVE) == pytest.approx(100 * (factor - 1), abs=1e-9)


@pytest.mark.parametrize("shift", [-0.7, 0.0, 0.3, 12.0])
def test_a_curve_so_many_decibels_higher(shift: float) -> None:
    other = [(rate, quality + shift) for rate, quality in CURVE]
    assert bd_psnr(other, CURVE) == pytest.approx(shift, abs=1e-9)


def test_two_points_are_a_line_over_the_logarithm_of_the_rate() -> None:
    line, higher = ((1.0, 30.0), (math.e**2, 34.0)), ((1.0, 31.0), (math.e**2, 35.0))
    # Over the qualities that both have, one decibel is half a unit of the logarithm.
    assert bd_rate(higher, line) == pytest.approx(100 * math.expm1(-0.5))
    assert psnr_at(line, math.e) == pytest.approx(32.0)
    assert rate_at(line, 33.0) == pytest.approx(math.e**1.5)


@given(curves(), curves())
def test_the_interpolation_is_that_of_scipy_and_its_integral_exact(one: Points, other: Points) -> None:
    ours, theirs = (PchipInterpolator(np.log([rate for rate, _ in c]), [db for _, db in c]) for c in (one, other))
    start, end = max(ours.x[0], theirs.x[0]), min(ours.x[-1], theirs.x[-1])
    expected = (ours.integrate(start, end) - theirs.integrate(start, end)) / (end - start)
    assert bd_psnr(one, other) == pytest.approx(expected, abs=1e-7)
    middle = math.exp((start + end) / 2)
    assert psnr_at(one, middle) == pytest.approx(float(ours(math.log(middle))), abs=1e-7)


@given(curves(), curves())
def test_the_other_way_round_it_is_the_inverse(one: Points, other: Points) -> None:
    assert bd_psnr(one, other) == pytest.approx(-bd_psnr(other, one), abs=1e-9)
    there, back = (1 + bd_rate(*pair) / 100 for pair in ((one, other), (other, one)))
    assert there * back == pytest.approx(1.0)
    assert bd_rate(one, one) == 0.0


@given(curves(), st.floats(0.0, 1.0))
def test_what_a_curve_says_lies_between_its_points_and_rises(curve: Points, share: float) -> None:
    (first, lowest), (last, highest) = curve[0], curve[-1]
    rate = min(max(first ** (1 - share) * last**share, first), last)
    quality = psnr_at(curve, rate)
    assert quality is not None
    assert lowest - 1e-9 <= quality <= highest + 1e-9
    finer = psnr_at(curve, min(rate * 1.1, last))
    assert finer is not None
    assert finer >= quality - 1e-9


def test_points_come_in_any_order_and_are_met() -> None:
    backwards = CURVE[::-1]
    for rate, quality in CURVE:
        assert psnr_at(backwards, rate) == pytest.approx(quality)
        assert rate_at(backwards, quality) == pytest.approx(rate)
    assert bd_rate(backwards, CURVE) == 0.0


def test_outside_of_a_curve_nothing_is_said() -> None:
    assert rate_at(CURVE, 27.49) is rate_at(CURVE, 31.11) is None
    assert psnr_at(CURVE, 3.99) is psnr_at(CURVE, 95.01) is psnr_at(CURVE, 0.0) is None


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([], "two points or more, got 0"),
        (CURVE[:1], "two points or more, got 1"),
        ([(0.0, 30.0), (1.0, 31.0)], "must be positive"),
        ([(1.0, 30.0), (2.0, math.inf)], "must be positive and its qualities finite"),
        ([(1.0, 30.0), (2.0, 29.0)], "more rate must be more quality"),
        ([(1.0, 30.0), (1.0, 31.0)], "more rate must be more quality"),
    ],
)
def test_what_is_no_curve_is_refused(points: Points, words: str) -> None:
    for compare in (bd_rate, bd_psnr):
        with pytest.raises(ConfigError, match=words):
            compare(CURVE, points)
        with pytest.raises(ConfigError, match=words):
            compare(points, CURVE)


def test_curves_that_share_nothing_are_not_compared() -> None:
    higher = [(rate, quality + 10.0) for rate, quality in CURVE]
    with pytest.raises(ConfigError, match="share no quality"):
        bd_rate(CURVE, higher)
    dearer = [(rate * 100.0, quality) for rate, quality in CURVE]
    with pytest.raises(ConfigError, match="share no rate"):
        bd_psnr(CURVE, dearer)
