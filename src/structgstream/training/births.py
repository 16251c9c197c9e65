# SPDX-License-Identifier: Apache-2.0
"""What emerges is there, opaque, before the first iteration: free Gaussians from geometry (design, births).

A gradient makes a child only beside a parent, faint, and lets it find its place over frames. Where pixels of several
views stay wrong after everything has moved, the pictures themselves tell what is there and where: along the ray of such
a pixel, in front of what is rendered, there is a depth at which the other views lack the same colour.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from structgstream.errors import MissingExtraError
from structgstream.kernels.backend import Backend
from structgstream.kernels.motion_types import SweepView
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.training.residuals import ResidualFloor, box_mean, residual
from structgstream.training.views import View, area_mean

MASK_PIXELS = 5
HIT_VOXELS = 1.8


@dataclass(frozen=True)
class BirthConfig:
    """When free Gaussians are born from geometry, and die of blame."""

    enabled: bool = False
    """Off, the paper: gradients alone make children."""
    picture_width: int = 320
    """Pictures are looked at in at most this width."""
    residual_threshold: float = 0.10
    """A pixel is missing where the rendering is off by so much more than frame 0's was."""
    pixel_step: int = 2
    """A ray is swept for every so many-th missing pixel, across and down."""
    planes: int = 48
    least_supports: int = 2
    """Other views that must lack the same."""
    most_contradictions: float = 0.34
    """At most this share of the views that could see a point may lack nothing there."""
    most_cost: float = 0.12
    least_hits: int = 4
    """Points of as many rays must lie within 1.8 voxels."""
    most: int = 500
    """Births a frame; those with most hits come first."""
    most_missing_share: float = 0.25
    """Where more of the pictures than this is missing, nothing emerged: a light was switched, or a camera bumped."""
    size: float = 0.7
    """Standard deviation at birth, in distances between rays."""
    opacity: float = 0.7
    blame_share: float = 0.5
    """A free Gaussian is to blame in a view where so much of what it covers is wrong, ..."""
    blame_views: int = 2
    """... and dies when so many views, and half of those that show it, blame it."""


@dataclass(frozen=True)
class ViewResidual:
    """What the rendering of a view lacks.

    Args:
        view: the picture, at the width that is looked at.
        wrong: ``[h, w]`` bool, pixels that are off.
        missing_share: ``[h, w]`` how much of the 5 x 5 pixels around is off by more than frame 0 was anywhere near.
    """

    view: View
    wrong: Tensor
    missing_share: Tensor


def view_residual(picture: Tensor, view: View, *, floor: ResidualFloor | None, config: BirthConfig) -> ViewResidual:
    """Compare a rendering as recorded, ``[H, W, 3]`` in 0 ... 1, with the picture of ``view``."""
    scale = min(1.0, config.picture_width / view.camera.width)
    small = view.reduced(scale)
    size = (small.camera.height, small.camera.width)
    seen = area_mean(picture.permute(2, 0, 1)[None], size)[0].permute(1, 2, 0)
    off = residual(seen, small.image)
    limit = off.new_full((), config.residual_threshold)
    if floor is not None:
        limit = limit + interpolate(floor.maps[view.index][None, None], size=size, mode="bilinear")[0, 0]
    return ViewResidual(small, off > config.residual_threshold, box_mean((off > limit).float(), MASK_PIXELS))


def blamed_mask(coverage: Tensor, wrong: Tensor, *, least_pixels: float, config: BirthConfig) -> Tensor:
    """Mask ``[F]`` of the free Gaussians that several views blame.

    Args:
        coverage: ``[V, F]`` pixels that each covers.
        wrong: ``[V, F]`` those of them that are off.
        least_pixels: a view that sees less of a Gaussian says nothing.
        config: the rule.
    """
    seen = coverage > least_pixels
    bad = (seen & (wrong > config.blame_share * coverage)).sum(0)
    return (bad >= config.blame_views) & (2 * bad >= seen.sum(0))


def sweep_births(
    missing: Sequence[ViewResidual],
    depths: Mapping[int, Tensor],
    color: CameraColor,
    *,
    first_birth: int,
    config: BirthConfig,
    backend: Backend,
) -> FreeGaussians:
    """New free Gaussians where several views lack the same.

    Args:
        missing: of every training view.
        depths: by view index ``[h, w]`` of what is rendered, infinite where nothing is.
        color: corrections of the cameras.
        first_birth: identity of the first.
        config: the rule.
        backend: what computes.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    views = [_sweep_view(entry, depths[entry.view.index], color) for entry in missing]
    points, colors, spacings = [], [], []
    for index, (entry, view) in enumerate(zip(missing, views)):
        lacking = entry.missing_share > 0.5
        rows, columns = (lacking & _strided_mask(config.pixel_step, lacking)).nonzero().unbind(1)
        if not len(rows):
            continue
        reachable = view.depths[view.depths.isfinite()]
        beyond = float(reachable.max()) if len(reachable) else 1e3 * view.near
        farthest = (1.02 * view.depths[rows, columns].clamp(max=beyond)).clamp(min=1.001 * view.near)
        swept = backend.sweep(
            views,
            index,
            torch.stack([columns, rows], -1),
            farthest,
            planes=config.planes,
            least_supports=config.least_supports,
            most_contradictions=config.most_contradictions,
        )
        good = swept.costs < config.most_cost
        z, x, y = swept.depths[good], columns[good] + 0.5, rows[good] + 0.5
        K, viewmat = view.K, view.viewmat
        local = torch.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], -1)
        points.append((local - viewmat[:3, 3]) @ viewmat[:3, :3])
        colors.append(view.colors[rows[good], columns[good]])
        spacings.append(config.pixel_step * z / K[0, 0])
    if not points or not sum(len(group) for group in points):
        return FreeGaussians.empty(views[0].colors)
    return _merge_points(
        torch.cat(points), torch.cat(colors), torch.cat(spacings), first_birth=first_birth, config=config
    )


def _sweep_view(entry: ViewResidual, depths: Tensor, color: CameraColor) -> SweepView:
    camera, index = entry.view.camera, entry.view.index
    colors = (entry.view.colors - color.biases[index]) / color.gains[index].clamp(min=1e-3)
    viewport = camera.viewport(colors)
    return SweepView(colors, entry.missing_share, depths, viewport.viewmat, viewport.K, camera.near)


def _strided_mask(step: int, like: Tensor) -> Tensor:
    """Every ``step``-th pixel across and down."""
    mask = torch.zeros_like(like)
    mask[::step, ::step] = True
    return mask


def _merge_points(
    points: Tensor, colors: Tensor, spacings: Tensor, *, first_birth: int, config: BirthConfig
) -> FreeGaussians:
    """One free Gaussian for each voxel of the points, if enough of them lie around it."""
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise MissingExtraError("scipy", "capture") from error
    voxel = float(spacings.median())
    cells, of = (points / voxel).round().to(torch.int64).unique(dim=0, return_inverse=True)
    counts = points.new_zeros(len(cells)).index_add_(0, of, torch.ones_like(spacings))
    values = torch.cat([points, colors, spacings[:, None]], dim=1)
    means = values.new_zeros(len(cells), 7).index_add_(0, of, values) / counts[:, None]
    tree = KDTree(points.double().numpy(force=True))
    hits = tree.query_ball_point(means[:, :3].double().numpy(force=True), HIT_VOXELS * voxel, return_length=True)
    hits = torch.from_numpy(np.asarray(hits)).to(points.device)
    order = hits.argsort(descending=True, stable=True)
    chosen = order[hits[order] >= config.least_hits][: config.most].sort().values
    count = len(chosen)
    centers, looks, sizes = means[chosen].split([3, 3, 1], dim=1)
    unit = points.new_tensor([1.0, 0.0, 0.0, 0.0])
    opacity = torch.logit(torch.tensor(config.opacity)).to(points)
    return FreeGaussians(
        means=centers.contiguous(),
        log_scales=(config.size * sizes).log().expand(count, 3).contiguous(),
        quats=unit.expand(count, 4).clone(),
        logit_opacities=opacity.expand(count).clone(),
        colors=looks.contiguous(),
        births=first_birth + torch.arange(count, device=points.device),
    )
