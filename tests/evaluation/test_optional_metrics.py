# SPDX-License-Identifier: Apache-2.0
"""What can be measured here, what cannot and why, and the distances over time one by one."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.errors import ConfigError
from structgstream.evaluation.flip import features_of, flip_of
from structgstream.evaluation.lpips import ALEX, ENVIRONMENT, VGG, Lpips, published_heads
from structgstream.evaluation.optional_metrics import TEMPORAL, OptionalMetrics, load_optional_metrics, optional_scores
from structgstream.flow import dis_search
from tests.support.rigs import arc_rig

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))


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


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (40, 48, 3)).astype(np.uint8)


def test_missing_weights_are_reported_and_nothing_takes_their_place() -> None:
    optional_metrics = load_optional_metrics(cameras(640, 360), frames=5, device=CPU)
    assert set(optional_metrics.not_available) == {"lpips_alex", "t_lpips", "lpips_vgg"}
    assert ALEX.file in optional_metrics.not_available["t_lpips"]
    assert VGG.file in optional_metrics.not_available["lpips_vgg"]
    assert optional_metrics.lpips == {}
    scores, _ = optional_scores(optional_metrics, truth=noise(0), picture=noise(1), before=None)
    assert scores["lpips_alex"] is scores["lpips_vgg"] is None
    assert scores["flip"] == flip(noise(1), noise(0))


def test_missing_packages_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    optional_metrics = load_optional_metrics(cameras(640, 360), frames=5, device=CPU)
    for name in ("flip", "temporal_flip", "e_warp"):
        assert "structgstream[eval]" in optional_metrics.not_available[name]
    _, before = optional_scores(optional_metrics, truth=noise(0), picture=noise(1), before=None)
    scores, _ = optional_scores(optional_metrics, truth=noise(0), picture=noise(1), before=before)
    assert scores.get("flip") is scores.get("e_warp") is scores.get("temporal_flip") is None
    assert scores["flicker"] == 0.0


def test_small_pictures_and_short_streams_are_reported() -> None:
    optional_metrics = load_optional_metrics(cameras(48, 32), frames=1, device=CPU)
    assert "161 pixels a side, fewer are those of cam00 (32)" in optional_metrics.not_available["ms_ssim"]
    assert {optional_metrics.not_available[name] for name in TEMPORAL} == {
        "the stream has one frame, and this score compares two"
    }


def test_wrong_weights_are_an_error_not_a_gap(tmp_path: Path) -> None:
    torch.save({"features.0.weight": torch.zeros(3)}, tmp_path / "alexnet.pth")
    with pytest.raises(ConfigError, match="no weights of AlexNet"):
        load_optional_metrics(cameras(640, 360), frames=5, device=CPU, lpips_weights=tmp_path)


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
