# SPDX-License-Identifier: Apache-2.0
"""The scene of a frame as the start of another period's first frame: anchors only, everything trainable again."""

from dataclasses import replace

import numpy as np
import torch

from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.growth import cell_keys
from structgstream.training.neighbours import nearest


def warm_start(scene: Scene, *, cell: float) -> Scene:
    """``scene`` with its appearance in the features, its free Gaussians as anchors, and without environment.

    An environment belongs to frame 0's fit, which finds another one. Free Gaussians become one anchor for each cell of
    side ``cell`` (scene units) that has no anchor, with the features of the nearest one.
    """
    scene = scene.with_folded_appearance()
    anchors = scene.anchors
    if len(scene.free):
        anchors = _joined(anchors, _anchors_of(scene.free, anchors, cell))
    return replace(scene, anchors=anchors, free=FreeGaussians.empty(anchors.positions), environment=None)


def _anchors_of(free: FreeGaussians, anchors: AnchorCloud, cell: float) -> AnchorCloud:
    """An anchor for each cell that free Gaussians are in and no anchors: at their mean, as large as they are."""
    both = torch.cat([free.means, anchors.positions])
    places = (both / cell).round().to(torch.int64)
    origin = places.amin(0)
    extent = places.amax(0) - origin + 1
    keys = cell_keys(free.means, cell, origin, extent)
    fresh = ~torch.isin(keys, cell_keys(anchors.positions, cell, origin, extent))
    unique, index, count = keys[fresh].unique(return_inverse=True, return_counts=True)
    rows = torch.cat([free.means[fresh], free.log_scales[fresh].amax(1, keepdim=True)], dim=1)
    sums = rows.new_zeros(len(unique), 4).index_add_(0, index, rows)
    means = sums / count[:, None]
    # A Gaussian is at most as large as the base scale, and half of it on average.
    log_scales = (means[:, 3:] + np.log(2.0)).expand(-1, 3)
    return AnchorCloud(
        positions=means[:, :3].contiguous(),
        log_offset_scales=log_scales.contiguous(),
        log_base_scales=log_scales.contiguous(),
        offsets=means.new_zeros(len(unique), anchors.offsets_per_anchor, 3),
        features=anchors.features[nearest(means[:, :3], anchors.positions, 1)[0][:, 0]],
    )


def _joined(first: AnchorCloud, second: AnchorCloud) -> AnchorCloud:
    return AnchorCloud(
        positions=torch.cat([first.positions, second.positions]),
        log_offset_scales=torch.cat([first.log_offset_scales, second.log_offset_scales]),
        log_base_scales=torch.cat([first.log_base_scales, second.log_base_scales]),
        offsets=torch.cat([first.offsets, second.offsets]),
        features=torch.cat([first.features, second.features]),
    )
