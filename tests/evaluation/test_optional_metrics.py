# SPDX-License-Identifier: Apache-2.0
"""What can be measured here, what cannot and why, and scores over time in closed form."""

import sys

import cv2
import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.errors import MissingExtraError
from structgstream.evaluation.flip import features_of, flip_of
from structgstream.evaluation.lpips import ALEX, VGG, Lpips, published_heads
from structgstream.evaluation.optional_metrics import (
    TEMPORAL,
    OptionalMetrics,
    flicker,
    load_optional_metrics,
    optional_scores,
    warping_error,
)
from structgstream.flow import dis_search, inside
from tests.support.rigs import arc_rig

CPU = torch.device("cpu")


def cameras(width: int, height: int) -> list[tuple[str, Camera]]:
    return [("cam00", arc_rig(3, width=width, height=height)["cam00"])]


def seeded_alex() -> Lpips:
    generator = torch.Generator().manual_seed(2)
    weights = []
    for layer in ALEX.layers:
        out, into, size = layer.shape
        kernel = torch.randn(out, into, size, size, generator=generator) * (2 / (into * size**2)) ** 0.5
        weights.append((kernel, torch.zeros(out)))
    return Lpips(ALEX, tuple(weights), published_heads(ALEX))


def flip(one: np.ndarray, other: np.ndarray) -> float:
    return flip_of(features_of(one), features_of(other))


def noise(seed: int = 0, height: int = 40, width: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).integers(20, 200, (height, width, 3)).astype(np.uint8)


def test_missing_weights_are_reported_and_nothing_takes_their_place() -> None:
    optional_metrics = load_optional_metrics(cameras(640, 360), frames=5, device=CPU)
    assert set(optional_metrics.not_available) == {"lpips_alex", "t_lpips", "lpips_vgg"}
    assert ALEX.file in optional_metrics.not_available["t_lpips"]
    assert VGG.file in optional_metrics.not_available["lpips_vgg"]
    assert optional_metrics.lpips == {}
    scores, _ = optional_scores(optional_metrics, truth=noise(0), picture=noise(1), before=None)
    assert scores["lpips_alex"] is scores["lpips_vgg"] is None
    assert scores["flip"] == flip(noise(1), noise(0))


def test_without_opencv_there_are_only_the_basic_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"structgstream\[eval\]"):
        load_optional_metrics(cameras(640, 360), frames=5, device=CPU)


def textured(height: int = 96, width: int = 128) -> np.ndarray:
    picture = np.random.default_rng(3).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(picture, (0, 0), 2.5), np.empty_like(picture), 0, 255, cv2.NORM_MINMAX)


def test_what_moves_with_the_truth_has_little_warping_error_also_where_it_was_covered() -> None:
    """A bar moves to the left by 10: what it leaves was hidden behind it."""
    first = textured()
    second, bar = first.copy(), textured()[::-1, 40:70][:, ::-1]
    first[:, 60:90], second[:, 50:80] = bar, bar
    optional_metrics = OptionalMetrics(dis_search("eval"), {})
    _, before = optional_scores(optional_metrics, truth=first, picture=first, before=None)
    moves, stays = (
        optional_scores(optional_metrics, truth=second, picture=picture, before=before)[0]["e_warp"]
        for picture in (second, first)
    )
    assert 10 * moves < 0.01 < stays


def test_small_pictures_and_short_streams_are_reported() -> None:
    optional_metrics = load_optional_metrics(cameras(48, 32), frames=1, device=CPU)
    assert "161 pixels a side, fewer are those of cam00 (32)" in optional_metrics.not_available["ms_ssim"]
    assert {optional_metrics.not_available[name] for name in TEMPORAL} == {
        "the stream has one frame, and this score compares two"
    }


def test_scores_over_time_are_differences_of_distances() -> None:
    alex = seeded_alex()
    optional_metrics = OptionalMetrics(dis_search("eval"), {"alex": alex})
    truths, pictures = (noise(0), noise(1)), (noise(2), noise(2) // 2)
    _, before = optional_scores(optional_metrics, truth=truths[0], picture=pictures[0], before=None)
    scores, _ = optional_scores(optional_metrics, truth=truths[1], picture=pictures[1], before=before)

    def lpips(a: np.ndarray, b: np.ndarray) -> float:
        return alex.distance(alex.features(a), alex.features(b))

    assert scores["lpips_alex"] == pytest.approx(lpips(pictures[1], truths[1]))
    assert scores["t_lpips"] == pytest.approx(abs(lpips(*pictures) - lpips(*truths)), rel=1e-5)
    assert scores["temporal_flip"] == pytest.approx(abs(flip(*pictures[::-1]) - flip(*truths[::-1])))
    assert scores["t_lpips"] != 0.0


def error_of(now: np.ndarray, before: np.ndarray, *flow: float, seen: np.ndarray | None = None) -> float | None:
    """E_warp by a constant ``flow``, of the pixels ``seen`` or all whose source lies in the picture."""
    backward = np.broadcast_to(np.array(flow, np.float32), (*now.shape[:2], 2)).copy()
    return warping_error(now, before, backward, inside(backward) if seen is None else seen)


def test_a_picture_that_moves_with_its_flow_has_no_error() -> None:
    before = noise()
    now = np.roll(before, (1, 3), (0, 1))
    assert error_of(now, before, -3, -1) == pytest.approx(0.0, abs=1e-10)
    still = error_of(now, before, 0, 0)
    assert still > 1e-2


def test_a_change_of_brightness_is_its_square() -> None:
    before = noise()
    assert error_of(before + np.uint8(20), before, 0, 0) == pytest.approx((20 / 255) ** 2, rel=1e-6)


def test_only_seen_pixels_count() -> None:
    before, now = noise(), noise()
    now[3, 4] = 255 - now[3, 4]
    seen = np.ones(now.shape[:2], bool)
    assert error_of(now, before, 0, 0, seen=seen) != 0.0
    seen[3, 4] = False
    assert error_of(now, before, 0, 0, seen=seen) == pytest.approx(0.0, abs=1e-10)
    assert error_of(now, before, 0, 0, seen=np.zeros_like(seen)) is None


def test_flicker_is_the_mean_change_of_still_pixels_in_levels() -> None:
    before = noise()
    now, still = before.copy(), np.ones(before.shape[:2], bool)
    now[:20] += 4
    assert flicker(now, before, still) == pytest.approx(2.0)
    still[:20] = False
    assert flicker(now, before, still) == 0.0
    still[:] = False
    assert flicker(now, before, still) is None
