# SPDX-License-Identifier: Apache-2.0
"""What moves: only anchors and free Gaussians whose place in the pictures changed are fitted (design, change gate).

A Gaussian votes in every view that draws it: it may move if it covers changed pixels, and if they are a good part of
what it covers there. Blending weights are used, so what is hidden behind something does not vote.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName
from structgstream.training.views import View


@dataclass(frozen=True)
class MotionConfig:
    """When something counts as moving."""

    enabled: bool = False
    """Fit only what moves. Off, the paper: everything."""
    change_threshold: float = 0.05
    """Mean absolute difference, in 0 ... 1, of 3 x 3 pixels since the last frame; above the sensors' noise."""
    reach_pixels: int = 3
    """So far around a changed pixel things may have moved."""
    least_pixels: float = 0.3
    """A Gaussian votes in a view where it covers so many changed pixels, counted by blending weight ..."""
    least_share: float = 0.3
    """... and so large a part of what it covers."""
    least_views: int = 2
    """Votes that let an anchor, or a free Gaussian, move: one picture cannot tell motion from noise."""
    least_views_share: float = 0.0
    """So large a part of the views that show it must vote too: a wall beside which something passes in a few of them
    does not move."""
    moved_ease: float = 1.0
    """What the last frame changed needs only so many times the pixels and the share: what moves comes to rest in more
    than a frame, and what is at the edge of a change does not stutter. 1: no memory."""
    unseen_pixels: float = 0.0
    """Free Gaussians that cover less than this in every view, counted by blending weight, are removed. 0: none."""
    picture_scale: float = 0.25
    """Who covers what is found on pictures of this size."""
    margin_pixels: int = 8
    """Tiles this far around what moves are drawn too, so that it finds its loss where it goes."""
    full_every_frames: int = 0
    """Everything may move in every so many-th frame: changes too slow to be seen add up. 0: never."""
    tiles: bool = True
    """Draw only the tiles that moving Gaussians reach. Off: whole pictures, for the same result at their cost."""


SHARED_FIELDS: frozenset[FieldName] = frozenset({"opacity_mlp", "color_mlp", "covariance_mlp", "camera_color"})
"""What all anchors share changes only in frames in which everything may move: what stands still depends on it."""


@dataclass(frozen=True)
class Moving:
    """What may move in a frame.

    Args:
        anchors: mask ``[M]``.
        free: mask ``[F]``.
        unseen: mask ``[F]``, apart from ``free``: what no view shows.
        shown: for each view the Gaussians ``[M * K + F]`` (Note [Ids]) that are not hidden there.
    """

    anchors: Tensor
    free: Tensor
    unseen: Tensor
    shown: dict[int, Tensor]


def changed_since(older: Scene, scene: Scene) -> Tensor:
    """Mask ``[M + F]``, anchors before free Gaussians, of what ``scene`` has otherwise than ``older`` or not at all."""

    def differs(name: str, now: object, then: object) -> Tensor:
        changed = getattr(now, name) != getattr(then, name)
        return changed if changed.dim() == 1 else changed.any(1)

    rows = ("positions", "log_offset_scales", "log_base_scales", "appearance")
    anchors = torch.stack([differs(name, scene.anchors, older.anchors) for name in rows]).any(0)
    free = torch.ones_like(scene.free.births, dtype=torch.bool)
    was = torch.isin(scene.free.births, older.free.births)
    now, then = scene.free.select(was), older.free.select(torch.isin(older.free.births, scene.free.births))
    columns = ("means", "log_scales", "quats", "logit_opacities", "colors")
    free[was] = torch.stack([differs(name, now, then) for name in columns]).any(0)
    return torch.cat([anchors, free])


def moving_parts(
    scene: Scene,
    views: Sequence[View],
    before: Sequence[View],
    *,
    config: MotionConfig,
    backend: Backend,
    older: Scene | None = None,
) -> Moving:
    """What may move between the pictures ``before`` and those of ``views`` (same cameras, same order).

    Args:
        scene: as it was in the pictures ``before``.
        views: of the frame.
        before: of the frame before.
        config: what counts as moving.
        backend: what computes.
        older: the scene a frame earlier, for ``moved_ease``; None for none.
    """
    k, anchors, free = scene.anchors.offsets_per_anchor, len(scene.anchors), len(scene.free)
    votes = torch.zeros(anchors + free, device=scene.anchors.positions.device)
    seen = torch.zeros_like(votes)
    ease = torch.ones_like(votes)
    if older is not None:
        ease[changed_since(older, scene)] = config.moved_ease
    most = torch.zeros(free, device=votes.device)
    shown: dict[int, Tensor] = {}
    with torch.no_grad():
        scene = scene.baked()
        for view, last in zip(views, before, strict=True):
            changed = backend.changed_pixels(
                last.image, view.image, threshold=config.change_threshold, reach_pixels=config.reach_pixels
            )
            weights = _weights(scene, view.camera, changed, config, backend)
            # The K Gaussians of an anchor vote together: it moves as one.
            structured, single = weights[: anchors * k].reshape(anchors, k, 2), weights[anchors * k :]
            total, part = torch.cat([structured.sum(1), single]).unbind(1)
            seen += total > config.least_pixels
            votes += (part > config.least_pixels * ease) & (part > config.least_share * ease * total)
            most = torch.maximum(most, single[:, 0])
            shown[view.index] = weights[:, 0] > config.least_pixels
    enough = (votes >= config.least_views) & (votes >= config.least_views_share * ease * seen)
    unseen = most < config.unseen_pixels
    return Moving(enough[:anchors], enough[anchors:] & ~unseen, unseen, shown)


def _weights(scene: Scene, camera: Camera, changed: Tensor, config: MotionConfig, backend: Backend) -> Tensor:
    """Blending weight of each Gaussian over the picture and over its changed part, ``[M * K + F, 2]`` pixels."""
    height, width = changed.shape
    small = camera.resized(*(max(1, round(size * config.picture_scale)) for size in (width, height)))
    gaussians = scene.gaussians(small, backend)
    part = torch.nn.functional.interpolate(
        changed[None, None].to(gaussians.means), size=(small.height, small.width), mode="area"
    )[0, 0]
    found = backend.blending_weights(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        *small.beside(gaussians.means)[:2],
        torch.stack([torch.ones_like(part), part], dim=-1),
        near=small.near,
    )
    slots = len(scene.anchors) * scene.anchors.offsets_per_anchor + len(scene.free)
    weights = found.new_zeros(slots, 2)
    weights[gaussians.ids] = found * (changed.numel() / part.numel())
    return weights
