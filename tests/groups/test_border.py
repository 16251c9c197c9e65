# SPDX-License-Identifier: Apache-2.0
"""What moves at a border is found from renderings."""

from dataclasses import replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.groups.base import GroupBase
from structgstream.groups.seam_blend import draw_border, moving_at_border
from structgstream.scene.scene import Scene
from structgstream.training.online.measure import primitive_sums, slot_count
from tests.support.backends import quickest_backend
from tests.support.clip_groups import made


def most_seen(scene: Scene, rig: CameraRig) -> int:
    """The anchor that covers most of the pictures."""
    backend, cameras = quickest_backend(), [rig[name] for name in rig.training]
    viewports = [camera.viewport(scene.anchors.positions) for camera in cameras]
    maps = torch.ones(len(cameras), cameras[0].height, cameras[0].width, 1)
    gaussians = scene.gaussians_of_views(cameras, backend)
    sums = backend.weigh_views(gaussians, viewports, maps, slots=slot_count(scene))
    return int(primitive_sums(sums.sum(0), scene)[: len(scene.anchors)].argmax())


def moving(before: Scene, first: Scene, rig: CameraRig, **around: Scene) -> Tensor | None:
    backend = quickest_backend()
    return moving_at_border(before, first, draw_border(before, first, rig, backend), rig, backend, **around)


def test_what_moved_is_found_and_what_did_not_is_not() -> None:
    base = GroupBase.read(made().header)
    first, rig = base.scene(), base.header.similarity.rig(base.header.rig)
    at = first.anchors.positions
    center = at[most_seen(first, rig)]
    there = (at - center).norm(dim=1) < (at - center).norm(dim=1).quantile(0.1)
    before = replace(first, anchors=replace(first.anchors, positions=at + 0.3 * there[:, None]))
    found = moving(first, first, rig)
    assert found is not None
    assert not found.any()
    found = moving(before, first, rig)
    assert found is not None
    # Pictures of 80x60 show few of the anchors in a heap.
    assert found[there].float().mean() > 3.0 * found[~there].float().mean()
    slowly = replace(first, anchors=replace(first.anchors, positions=at + 1e-4 * there[:, None]))
    for around in ({"second": slowly}, {"earlier": slowly}):
        found = moving(first, first, rig, **around)
        assert found is not None
        assert torch.equal(found, there)


def test_at_a_cut_nothing_is_handed_over() -> None:
    base = GroupBase.read(made().header)
    first, rig = base.scene(), base.header.similarity.rig(base.header.rig)
    gone = replace(first, anchors=replace(first.anchors, positions=first.anchors.positions + 50.0))
    assert moving(gone, first, rig, second=first) is None
