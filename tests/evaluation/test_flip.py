# SPDX-License-Identifier: Apache-2.0
"""FLIP goes into its authors' package in the right units."""

import sys

import numpy as np
import pytest

from structgstream.errors import MissingExtraError
from structgstream.evaluation.flip import flip, flip_evaluator, flip_map


def grey(level: int) -> np.ndarray:
    return np.full((24, 32, 3), level, np.uint8)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (24, 32, 3)).astype(np.uint8)


def test_equal_pictures_have_none_and_black_on_white_nearly_all() -> None:
    assert flip(noise(0), noise(0)) == 0.0
    assert 0.9 < flip(grey(0), grey(255)) <= 1.0


def test_it_grows_with_the_difference_and_is_the_mean_of_its_map() -> None:
    small, large = flip(grey(110), grey(100)), flip(grey(140), grey(100))
    assert 0.0 < small < large < 1.0
    errors = flip_map(noise(0), noise(1))
    assert errors.shape == (24, 32)
    assert flip(noise(0), noise(1)) == pytest.approx(errors.mean(), abs=1e-6)


def test_pictures_count_in_parts_of_full_scale_and_conditions_are_the_default() -> None:
    theirs = flip_evaluator()(noise(1) / 255.0, noise(0) / 255.0, "LDR", applyMagma=False)
    assert flip(noise(0), noise(1)) == pytest.approx(theirs[1], abs=1e-6)
    assert theirs[2]["ppd"] == pytest.approx(0.7 * 3840 / 0.7 * np.pi / 180, abs=0.01)


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(MissingExtraError, match=r"structgstream\[eval\]"):
        flip(noise(0), noise(1))
