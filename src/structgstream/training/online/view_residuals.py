# SPDX-License-Identifier: Apache-2.0
"""Where renderings differ from the pictures: wrong pixels, and missing ones that were right in frame 0."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from structgstream.kernels.backend import Backend
from structgstream.kernels.values import TileSelection
from structgstream.scene.color import CameraColor
from structgstream.training.online.config import SpawnRules
from structgstream.training.residuals import BaselineResidual, box_mean
from structgstream.training.views import View, in_groups, mean_of_counting, reduced_views, stacked_masks

MASK_PIXELS = 5
"""Side of the squares over which missing pixels are counted."""


@dataclass(frozen=True)
class ViewResidual:
    """Wrong and missing pixels of a view.

    Args:
        view: the picture, reduced.
        wrong: ``[h, w]`` bool, pixels whose residual exceeds the threshold.
        missing_share: ``[h, w]`` share of the 5 x 5 pixels around each pixel whose residual exceeds frame 0's by more
            than the threshold.
        missing_pixels: share of the pixels that count whose ``missing_share`` is above one half.
    """

    view: View
    wrong: Tensor
    missing_share: Tensor
    missing_pixels: float = 0.0


def view_residuals(
    drawn: Sequence[Tensor | None],
    views: Sequence[View],
    color: CameraColor,
    *,
    baseline: BaselineResidual | None,
    rules: SpawnRules,
    backend: Backend,
    tiles: Sequence[TileSelection | None] | None = None,
) -> list[ViewResidual]:
    """Compare renderings ``[H, W, 3]`` with the pictures of ``views``.

    Args:
        drawn: by view, the rendering; None for one that is the picture itself.
        views: in full size.
        color: the colour correction of the cameras.
        baseline: residuals of frame 0; None for none.
        rules: the rules.
        backend: the compute back-end.
        tiles: by view, the tiles that were drawn; elsewhere it is the picture. None for all.
    """
    given = list(zip(drawn, views, [None] * len(views) if tiles is None else tiles, strict=True))

    def kind(of_view: tuple[Tensor | None, View, TileSelection | None]) -> Hashable:
        image, view, _ = of_view
        return view.image.shape, image is None, baseline is not None and view.index not in baseline.maps

    return in_groups(
        given,
        kind,
        lambda alike: _view_residuals(alike, color, baseline, rules, backend),
        device=backend.device,
    )


def _view_residuals(
    given: Sequence[tuple[Tensor | None, View, TileSelection | None]],
    color: CameraColor,
    baseline: BaselineResidual | None,
    rules: SpawnRules,
    backend: Backend,
) -> list[ViewResidual]:
    """Of views of one size, all or none of which were drawn and have a baseline."""
    views = [view for _, view, _ in given]
    small = reduced_views(views, min(1.0, rules.longer_side / max(views[0].camera.width, views[0].camera.height)))
    pictures, masks = torch.stack([view.image for view in small]), stacked_masks(small)
    images = [image for image, _, _ in given if image is not None]
    selected = [of_view for _, _, of_view in given if of_view is not None]
    if not images or (baseline is not None and views[0].index not in baseline.maps):
        # Of a camera that was absent from frame 0 nothing is known to be new.
        none = torch.zeros(pictures.shape[:3], device=pictures.device)
        nothing = torch.zeros_like(none, dtype=torch.bool)
        if images:
            small = [View(v.index, v.camera, v.image, mask) for v, mask in zip(small, nothing, strict=True)]
        return [ViewResidual(*of_view) for of_view in zip(small, nothing, none, strict=True)]
    seen = color.of_cameras([view.index for view in views])
    off = backend.picture_residuals(
        images,
        pictures,
        gains=seen.gains,
        biases=seen.biases,
        tiles=selected or None,
        outside=[view.image for view in views] if selected else None,
        masks=masks,
    )
    limits = off.new_full((), rules.missing_threshold)
    if baseline is not None:
        baselines = torch.stack([baseline.maps[view.index] for view in views])[:, None]
        limits = limits + interpolate(baselines, size=off.shape[1:], mode="bilinear")[:, 0]
    missing = box_mean((off > limits).float(), MASK_PIXELS)
    missing = missing if masks is None else missing * masks
    shares = mean_of_counting((missing > 0.5).float(), masks).tolist()
    results = zip(small, off > rules.residual_threshold, missing, shares, strict=True)
    return [ViewResidual(*of_view) for of_view in results]
