# SPDX-License-Identifier: Apache-2.0
"""Global light: what all cameras see fade or brighten together, slower than the selection notices.

Lamps warm up, the sun goes, and every pixel follows by a fraction of a level per frame. No pixel changes, so nothing is
trained, and what stands still keeps frame 0's colours. Here the change since frame 0 is measured in the training
pictures, where they show the same as in frame 0, and added to the output biases of F_c: one number per colour channel
for all anchors.

Note [Light]
~~~~~~~~~~~~
F_c's colours are c = sigmoid(x), so a change d of the biases changes a picture by s d to first order, with s = gain c
(1 - c). In each view d is fitted by least squares to the difference of the two pictures; the median over the views
leaves out cameras that correct their own exposure. The fit is against the pictures of frame 0, not against renderings
or the last frame, so errors do not accumulate and renderings' own errors do not enter.

Where the light is steady, the estimate still wavers by up to half of ``MIN_CHANGE``, and what would follow that
flickers. Where it fades, coarse steps show and lag behind. So the first step takes a large change, and later ones small
changes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.codec.fields.quantization import round_straight_through
from structgstream.scene.color import CameraColor
from structgstream.scene.scene import Scene
from structgstream.training.online.config import ExposureConfig
from structgstream.training.views import View, by_size, dilated, evidence_views, stacked_colors, stacked_masks

MIN_COMPARED_VIEWS = 3
"""Fewer views have no median that leaves one out."""
REACH_PIXELS = 2
"""Pixels of the reduced pictures around one that shows something else do not count."""


@dataclass(frozen=True)
class ExposureReference:
    """Frame 0, which the light of later frames is compared with.

    Args:
        views: reduced, by view index. Cameras that were absent do not count.
        biases: ``[3 K]`` output biases of the decoded F_c.
    """

    views: Mapping[int, View]
    biases: Tensor


def exposure_reference(scene: Scene, views: Sequence[View], *, config: ExposureConfig) -> ExposureReference:
    """The reference of a stream whose decoded frame 0 is ``scene`` and has the pictures ``views``."""
    small = {view.index: view.evidence(config.PICTURE_SCALE) for view in views}
    return ExposureReference(small, scene.mlps.color.b2.detach().clone())


def with_exposure_of(
    scene: Scene, views: Sequence[View], reference: ExposureReference, *, config: ExposureConfig, step: float | None
) -> Scene:
    """``scene`` in the light of ``views``.

    Args:
        scene: of the last frame.
        views: of this frame.
        reference: frame 0.
        config: thresholds.
        step: quantization step of F_c's weights; None for none.
    """
    head = scene.mlps.color
    so_far = (head.b2 - reference.biases).reshape(-1, 3)[0]
    found = _light_change(scene, views, reference, so_far, config)
    least = torch.where(so_far.any(), config.MIN_FURTHER_CHANGE, config.MIN_CHANGE)
    wanted = torch.where((found - so_far).abs() < least, so_far, found)
    biases = reference.biases + wanted.repeat(len(head.b2) // 3)
    if step is not None:
        biases = round_straight_through(biases, step)
    if not bool((wanted != so_far).any() & (biases != head.b2).any()):
        return scene
    return replace(scene, mlps=scene.mlps._replace(color=head._replace(b2=biases)))


def _light_change(
    scene: Scene, views: Sequence[View], reference: ExposureReference, so_far: Tensor, config: ExposureConfig
) -> Tensor:
    """Change ``[3]`` of the biases since frame 0; ``so_far`` if too few views can be compared."""
    compared = evidence_views([view for view in views if view.index in reference.views], config.PICTURE_SCALE)
    if len(compared) < MIN_COMPARED_VIEWS:
        return so_far
    with torch.no_grad():
        changes = torch.stack(
            by_size(
                compared,
                lambda now: _view_changes(
                    now, [reference.views[view.index] for view in now], scene.camera_color, so_far, config
                ),
            )
        )
        enough = changes.isfinite().all(1).sum() >= MIN_COMPARED_VIEWS
        return torch.where(enough, changes.nanquantile(0.5, dim=0), so_far)


def _view_changes(
    now: Sequence[View], then: Sequence[View], color: CameraColor, so_far: Tensor, config: ExposureConfig
) -> Tensor:
    """The change ``[V, 3]`` that each camera saw (Note [Light]); NaN if its pictures have too little in common."""
    seen = color.of_cameras([view.index for view in now])
    gains, biases = seen.gains[:, None, None], seen.biases[:, None, None]
    before = stacked_colors(then)
    colors = ((before - biases) / gains).clamp(0.0, 1.0)
    sensitivity = gains * colors * (1.0 - colors)
    difference = stacked_colors(now) - before
    other = (difference - sensitivity * so_far).abs().mean(-1) > config.SAME_THRESHOLD
    for masks in (stacked_masks(now), stacked_masks(then)):
        other = other if masks is None else other | ~masks
    same = ~dilated(other, REACH_PIXELS)
    squares = sensitivity.square()
    weight = (squares * same[..., None]).sum((1, 2))
    enough = (weight > config.MIN_SHARE * squares.sum((1, 2))).all(1, keepdim=True)
    return torch.where(enough, (difference * sensitivity * same[..., None]).sum((1, 2)) / weight, torch.nan)
