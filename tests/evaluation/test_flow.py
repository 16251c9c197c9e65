# SPDX-License-Identifier: Apache-2.0
"""Flow of pictures that were moved by known amounts."""

import sys

import cv2
import numpy as np
import pytest

from structgstream.errors import MissingExtraError
from structgstream.evaluation.flow import agreeing, dis_flow, inside, sampled


def textured(height: int = 96, width: int = 128) -> np.ndarray:
    noise = np.random.default_rng(3).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), np.empty_like(noise), 0, 255, cv2.NORM_MINMAX)


def constant(dx: float, dy: float, height: int = 6, width: int = 8) -> np.ndarray:
    return np.broadcast_to(np.array([dx, dy], np.float32), (height, width, 2)).copy()


def test_a_shift_is_found() -> None:
    before = textured()
    now = np.roll(before, (2, 5), (0, 1))  # down by 2, right by 5: pixels were 5 left of and 2 above where they are
    field = dis_flow()(before, now, "cam", 1)
    inner = field.offsets[12:-12, 12:-12].reshape(-1, 2)
    np.testing.assert_allclose(np.median(inner, 0), [-5, -2], atol=0.1)
    assert np.mean(np.abs(inner - [-5, -2]).max(1) < 0.5) > 0.97
    assert field.seen[12:-12, 12:-12].mean() > 0.97
    assert not field.seen[:, :3].any()  # came from beyond the left border


def test_what_was_covered_is_not_seen() -> None:
    """A bar moves to the left by 10: what it leaves was hidden behind it."""
    before = textured()
    now = before.copy()
    bar = textured()[::-1, 40:70][:, ::-1]
    before[:, 60:90], now[:, 50:80] = bar, bar
    field = dis_flow()(before, now, "cam", 1)
    assert field.seen[10:-10, 56:74].mean() > 0.9
    assert field.seen[10:-10, 82:88].mean() < 0.5
    assert field.seen[10:-10, 10:40].mean() > 0.95


def test_the_rule_of_occlusion_at_its_threshold() -> None:
    def holds(rest: float, length: float) -> bool:
        backward, forward = constant(-length, 0, width=40), constant(length + rest, 0, width=40)
        return bool(agreeing(backward, forward)[3, 20])

    # At rest r and lengths a, a + r: r^2 <= 0.01 (a^2 + (a + r)^2) + 0.5.
    assert holds(0.70, 0.0)
    assert not holds(0.72, 0.0)
    assert holds(1.65, 10.0)  # 2.72 against 2.86
    assert not holds(1.75, 10.0)  # 3.06 against 2.88


def test_pixels_from_beyond_the_border_are_outside() -> None:
    mask = inside(constant(-2.5, 1.0))
    assert mask[:5, 3:].all()
    assert not mask[:, :3].any()
    assert not mask[5].any()


def test_sampling_is_bilinear() -> None:
    height, width = 6, 8
    y, x = np.mgrid[:height, :width].astype(np.float32)
    values = np.stack([x, y, 2 * x - y], 2)
    taken = sampled(values, constant(-0.25, 0.5))
    expected = np.stack([x - 0.25, y + 0.5, 2 * (x - 0.25) - (y + 0.5)], 2)
    np.testing.assert_allclose(taken[:5, 1:], expected[:5, 1:], atol=1e-4)
    assert taken[0, 0, 0] == pytest.approx(0.0, abs=1e-5)  # the border's value beyond it


def test_without_opencv_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"structgstream\[eval\]"):
        dis_flow()
