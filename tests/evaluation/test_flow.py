# SPDX-License-Identifier: Apache-2.0
"""Flow of pictures that were moved by known amounts."""

import cv2
import numpy as np

from structgstream.evaluation.optional_metrics import flow_field
from structgstream.flow import dis_search


def textured(height: int = 96, width: int = 128) -> np.ndarray:
    noise = np.random.default_rng(3).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), np.empty_like(noise), 0, 255, cv2.NORM_MINMAX)


def test_a_shift_is_found() -> None:
    before = textured()
    now = np.roll(before, (2, 5), (0, 1))  # down by 2, right by 5: pixels were 5 left of and 2 above where they are
    field = flow_field(dis_search("eval"), before, now)
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
    field = flow_field(dis_search("eval"), before, now)
    assert field.seen[10:-10, 56:74].mean() > 0.9
    assert field.seen[10:-10, 82:88].mean() < 0.5
    assert field.seen[10:-10, 10:40].mean() > 0.95
