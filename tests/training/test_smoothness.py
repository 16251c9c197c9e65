# SPDX-License-Identifier: Apache-2.0
"""The penalty on motion that differs from that of the neighbours."""

from dataclasses import replace

import pytest
import torch

from structgstream.cameras import Camera
from structgstream.scene.scene import Scene
from structgstream.training.online.config import SmoothnessConfig
from structgstream.training.online.smoothness import MotionSmoothness
from structgstream.training.parameters import pixel_size
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, random_scene
from tests.support.varied import varied

BACKEND = quickest_backend()
CONFIG = varied(SmoothnessConfig(weight=1.0), NEIGHBOURS=4, FEATURE_BANDWIDTH=0.0)


def _cameras() -> list[Camera]:
    rig = arc_rig(3)
    return [rig[name] for name in rig.training]


def _grid(features: torch.Tensor | None = None) -> Scene:
    """Five by five anchors, a tenth apart."""
    scene = random_scene(25)
    steps = 0.1 * (torch.arange(5.0) - 2.0)
    positions = torch.cartesian_prod(steps, steps, torch.zeros(1))
    anchors = replace(scene.anchors, positions=positions)
    return replace(scene, anchors=anchors if features is None else replace(anchors, features=features))


def _price(scene: Scene, config: SmoothnessConfig = CONFIG) -> MotionSmoothness:
    found = MotionSmoothness.of(scene, _cameras(), config=config)
    assert found is not None
    return found


def test_what_moves_as_one_is_free() -> None:
    scene = _grid()
    moved = scene.anchors.positions + torch.tensor([0.3, -0.2, 0.1])
    assert _price(scene).difference(moved, BACKEND).item() == pytest.approx(0.0, abs=1e-4)


def test_one_that_moves_alone_pays_its_way_in_pixels() -> None:
    scene = _grid()
    price = _price(scene)
    pixel = pixel_size(scene.anchors.positions, _cameras())
    assert pixel is not None
    moved = scene.anchors.positions.clone()
    moved[12, 0] += 8.0 * pixel
    length = (64.0 + 0.25**2) ** 0.5 - 0.25
    # Its own difference counts whole, and as a share of those whose neighbour it is.
    share = float(price.shares[price.neighbours == 12].sum())
    assert price.difference(moved, BACKEND).item() == pytest.approx((1.0 + share) * length / 25, rel=1e-4)


def test_what_looks_different_does_not_count() -> None:
    """Two halves of different features pass each other for nothing; without the weight by features they pay."""
    scene = _grid()
    features = torch.zeros_like(scene.anchors.features)
    right = scene.anchors.positions[:, 0] > 0.05
    features[right] = 20.0
    scene = _grid(features)
    moved = scene.anchors.positions.clone()
    moved[right, 1] += 0.2
    configs = varied(CONFIG, FEATURE_BANDWIDTH=0.1), CONFIG
    by_features, plain = (_price(scene, config).difference(moved, BACKEND).item() for config in configs)
    assert by_features < 0.05 * plain


def test_there_is_no_price_without_weight_company_or_view() -> None:
    scene = _grid()
    assert MotionSmoothness.of(scene, _cameras(), config=replace(CONFIG, weight=0.0)) is None
    alone = replace(scene, anchors=scene.anchors.select(torch.arange(1)))
    assert MotionSmoothness.of(alone, _cameras(), config=CONFIG) is None
    assert MotionSmoothness.of(scene, [], config=CONFIG) is None


def test_two_anchors_are_each_others_neighbours() -> None:
    scene = _grid()
    price = _price(replace(scene, anchors=scene.anchors.select(torch.arange(2))))
    assert price.neighbours.tolist() == [[1], [0]]
