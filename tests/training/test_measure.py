# SPDX-License-Identifier: Apache-2.0
"""What the pictures say of dynamic primitives: sums by blending weight, and where a primitive is visible."""

from dataclasses import replace

import numpy as np
import torch

from structgstream.frames import MultiViewFrame
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.measure import flow_evidence, measure, primitive_centers, primitive_sums, slot_count
from structgstream.training.online.preprocess import detect_changes
from structgstream.training.views import training_views
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, random_scene
from tests.support.worlds import emerging_ball

RIG = arc_rig(4, width=48, height=32)
CAMERA = RIG[RIG.training[0]]
BACKEND = quickest_backend()
CPU = torch.device("cpu")


def test_movers_are_anchors_then_free_gaussians() -> None:
    scene = random_scene(4, free=2)
    k = scene.anchors.offsets_per_anchor
    assert slot_count(scene) == 4 * k + 2
    found = primitive_sums(torch.arange(4.0 * k + 2)[:, None], scene)[:, 0]
    assert found.tolist() == [sum(range(i * k, i * k + k)) for i in range(4)] + [4 * k, 4 * k + 1]


def test_all_movers_may_be_free_gaussians() -> None:
    """A scene without anchors is what moves where only free Gaussians do."""
    scene, sums = random_scene(0, free=2), torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    assert primitive_sums(sums, scene).tolist() == sums.tolist()
    assert torch.equal(primitive_centers(scene, torch.ones(2)), scene.free.means)


def test_weighed_ones_are_what_a_gaussian_covers_and_what_is_in_front_takes_from_it() -> None:
    scene = random_scene(30, free=3)
    views, slots = ([scene.gaussians(CAMERA, BACKEND)], [CAMERA.viewport(scene.free.means)]), slot_count(scene)
    (alone,) = BACKEND.weigh_views(*views, torch.ones(1, 32, 48, 1), slots=slots)
    before = replace(emerging_ball(0.99), means=torch.tensor([[0.0, 0.0, -1.5]]), scales=torch.full((1, 3), 0.4))
    (covered,) = BACKEND.weigh_views(*views, torch.ones(1, 32, 48, 1), slots=slots, static=[before])
    assert float(covered.sum()) < 0.8 * float(alone.sum())
    assert (covered <= alone + 1e-4).all()


def test_evidence_is_a_mean_with_bounds() -> None:
    # c, c flow_x, c flow_y, cover, and colours times cover, of three movers in one view.
    sums = torch.tensor(
        [[4.0, 8.0, -4.0, 8.0, 4.0, 2.0, 0.0], [0.1, 1.0, 1.0, 1.0, 1, 1, 1], [90.0, 90, 0, 90, 0, 0, 9]]
    )
    found = flow_evidence([sums, torch.zeros_like(sums)])
    assert found.weights[0].tolist() == [4.0, 0.0, 20.0]
    assert found.flows[0, 0].tolist() == [2.0, -1.0]
    assert not found.weights[1].any()
    torch.testing.assert_close(found.colors[0], torch.tensor([0.5, 0.25, 0.0]))
    assert found.select(torch.tensor([2])).weights.shape == (2, 1)


def test_a_mover_is_where_its_gaussians_are_seen() -> None:
    scene = random_scene(2, free=1)
    anchors, k = scene.anchors, scene.anchors.offsets_per_anchor
    coverage = torch.zeros(2 * k + 1)
    coverage[3] = 5.0  # of the first anchor only its fourth Gaussian shows, of the second none
    found = primitive_centers(scene, coverage)
    fourth = anchors.positions[0] + anchors.offsets[0, 3] * anchors.log_offset_scales[0].exp()
    torch.testing.assert_close(found[0], fourth)
    torch.testing.assert_close(found[1], anchors.positions[1])
    torch.testing.assert_close(found[2], scene.free.means[0])


def test_coverage_keeps_no_memory_of_other_sums() -> None:
    """Sums by id have eight columns, of as many rows as the scene has Gaussians, for each view."""
    now, before = (
        training_views(MultiViewFrame(0, 0.0, {name: np.full((32, 48, 3), level, np.uint8) for name in RIG}), RIG, CPU)
        for level in (0, 99)
    )
    scene, config = random_scene(30, free=3), MotionConfig(enabled=True)
    changes = detect_changes(now, before, config=config, backend=BACKEND)
    for measured in measure(scene, now, changes, config=config, backend=BACKEND):
        assert measured.coverage.untyped_storage().nbytes() <= 4 * len(now) * slot_count(scene)
        assert measured.coverage.shape == (slot_count(scene),)
