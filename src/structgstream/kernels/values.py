# SPDX-License-Identifier: Apache-2.0
"""Arguments and results of operations: selections of tiles, renderings, anchors, flow in several views, sweeps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians

TILE_PIXELS = 16
"""Side of a tile, pixels; parts of a picture are selected by tile."""


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Number of rows and columns of tiles of a picture; the last ones may be partial."""
    return -(-height // TILE_PIXELS), -(-width // TILE_PIXELS)


@dataclass(frozen=True)
class TileSelection:
    """A selection of a picture's tiles.

    Args:
        mask: ``[rows, columns]`` bool.
        width: of the picture, pixels.
        height: of the picture, pixels.
    """

    mask: Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        assert self.mask.dtype == torch.bool, self.mask.dtype
        assert self.mask.shape == tile_grid(self.width, self.height), (self.mask.shape, self.width, self.height)

    @classmethod
    def of(cls, pixels: Tensor) -> "TileSelection":
        """The tiles that contain a pixel of the mask ``[H, W]``."""
        return cls.of_each(pixels[None])[0]

    @classmethod
    def of_each(cls, pixels: Tensor) -> "list[TileSelection]":
        """:meth:`of` of each of the masks ``[V, H, W]``."""
        count, height, width = pixels.shape
        rows, columns = tile_grid(width, height)
        padded = pixels.new_zeros(count, rows * TILE_PIXELS, columns * TILE_PIXELS)
        padded[:, :height, :width] = pixels
        masks = padded.reshape(count, rows, TILE_PIXELS, columns, TILE_PIXELS).any(4).any(2)
        return [cls(mask, width, height) for mask in masks]

    def pixels(self) -> Tensor:
        """Mask ``[H, W]`` of the pixels in the selected tiles; the same tensor in every call."""
        return self._pixels

    @cached_property
    def _pixels(self) -> Tensor:
        rows = self.mask.repeat_interleave(TILE_PIXELS, 0)
        return rows.repeat_interleave(TILE_PIXELS, 1)[: self.height, : self.width]

    def choose(self, inside: Tensor, outside: Tensor) -> Tensor:
        """A picture ``[H, W, 3]``: ``inside`` in the selected tiles, ``outside`` elsewhere."""
        return torch.where(self._samples, inside, outside)

    @cached_property
    def _samples(self) -> Tensor:
        """Mask ``[H, W, 3]``: a mask that is broadcast over the channels takes two to three times as long."""
        return torch.stack([self._pixels] * 3, dim=-1)

    def count_pixels(self) -> int:
        """Number of pixels in the selected tiles."""
        return int(self._pixels.sum())


def tile_pixels(tiles: Sequence[TileSelection]) -> Tensor:
    """Mask ``[V, H, W]`` of the pixels in the selected tiles of pictures of one size."""
    rows = torch.stack([of_view.mask for of_view in tiles]).repeat_interleave(TILE_PIXELS, 1)
    return rows.repeat_interleave(TILE_PIXELS, 2)[:, : tiles[0].height, : tiles[0].width]


@dataclass(frozen=True)
class RasterOutput:
    """One rendering.

    Args:
        image: ``[H, W, 3]``, not clamped; in tiles that were not selected zero, or the pixels of ``onto``.
        alpha: ``[H, W]`` coverage in [0, 1]; zero in tiles that were not selected.
        radii: ``[N]`` float32 pixels, 0 where a Gaussian was not drawn.
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor


Rasterizer = Callable[..., RasterOutput]
"""A function with the arguments and the result of ``reference_raster.rasterize``."""


class Anchors(NamedTuple):
    """The anchor fields that the generation reads, ``M`` anchors.

    Args:
        positions: ``[M, 3]``, x_v.
        log_offset_scales: ``[M, 3]``, log l_v.
        log_base_scales: ``[M, 3]``, log of the largest Gaussian scale.
        offsets: ``[M, K, 3]``, O_v.
        features: ``[M, D]``, f_v.
    """

    positions: Tensor
    log_offset_scales: Tensor
    log_base_scales: Tensor
    offsets: Tensor
    features: Tensor


class HeadWeights(NamedTuple):
    """One MLP with one hidden ReLU layer: ``w1 [hidden, inputs]``, ``b1``, ``w2 [outputs, hidden]``, ``b2``."""

    w1: Tensor
    b1: Tensor
    w2: Tensor
    b2: Tensor


class MLPWeights(NamedTuple):
    """The paper's F_alpha (K outputs, tanh), F_c (3K, sigmoid) and F_Sigma (7K, no activation)."""

    opacity: HeadWeights
    color: HeadWeights
    covariance: HeadWeights


@dataclass(frozen=True)
class StructuredGaussians:
    """The Gaussians of the anchors in a camera's view.

    Args:
        gaussians: those of positive opacity, ascending by id, with unit quaternions.
        anchors: ``[m]`` int64, ascending: the anchors that were evaluated, a superset of the visible ones.
        raw_opacities: ``[m, K]`` tanh outputs of these anchors, without a graph; positive ones are drawn.
    """

    gaussians: Gaussians
    anchors: Tensor
    raw_opacities: Tensor


class ViewFlows(NamedTuple):
    """Optical flow of ``E`` dynamic anchors and free Gaussians in ``V`` views.

    Args:
        weights: ``[V, E]`` W, sums of their blending weights over the pixels with reliable flow.
        flows: ``[V, E, 2]`` f, in units of its error.
        viewmats: ``[V, 4, 4]``.
        Ks: ``[V, 3, 3]``, pixels in that unit.
        near: ``[V]`` distance of the near plane along z.
    """

    weights: Tensor
    flows: Tensor
    viewmats: Tensor
    Ks: Tensor
    near: Tensor


class Neighbors(NamedTuple):
    """The rows of :class:`ViewFlows` whose flow determines each of ``T`` targets.

    Args:
        rows: ``[T, N]`` int64, in 0 ... E - 1.
        affinities: ``[T, N]`` g, their weights.
    """

    rows: Tensor
    affinities: Tensor


@dataclass(frozen=True)
class Lifted:
    """3D displacements fitted to optical flow.

    Args:
        displacements: ``[T, 3]``.
        inlier_share: ``[T]`` share of the flow's weight that are inliers (``reference_motion.lift``); 0 without flow.
        agreeing_views: ``[T]`` int64, number of views in which more than ``share`` of the weight are inliers.
    """

    displacements: Tensor
    inlier_share: Tensor
    agreeing_views: Tensor


@dataclass(frozen=True)
class SweepView:
    """A view of the plane sweep.

    Args:
        colors: ``[h, w, 3]`` picture, 0 ... 1, colour-corrected so that views are comparable.
        missing: ``[h, w]`` share of a pixel's neighbourhood with new content that the rendering lacks, 0 ... 1.
        depths: ``[h, w]`` rendered depth along z; infinite where nothing is rendered.
        viewmat: ``[4, 4]``.
        K: ``[3, 3]`` for a picture of that size.
        near: distance of the near plane along z.
    """

    colors: Tensor
    missing: Tensor
    depths: Tensor
    viewmat: Tensor
    K: Tensor
    near: float


@dataclass(frozen=True)
class Swept:
    """The best point of each ray.

    Args:
        depths: ``[P]`` along z; 0 for a ray without a valid point.
        costs: ``[P]`` least cost; infinite without a valid point.
    """

    depths: Tensor
    costs: Tensor


FIT_LEAVES = 11
"""Number of tensors of a frame's fit: positions, offset scales, base scales, offsets, features and appearance of
anchors; means, scales, quaternions, opacities and colours of free Gaussians."""


class FitLeaf(NamedTuple):
    """A tensor of a frame's fit: ``values``, with the rest for one that is trained.

    Args:
        values: updated in place.
        first: Adam's first moments, zero at the first iteration; None: not trained.
        second: its second moments.
        sums: get the values of the last iterations; None: no mean.
        before: values from which the rate term counts changes of the first rows; None: has none.
        step: the quantization step with which it is drawn; 0 for none.
    """

    values: Tensor
    first: Tensor | None = None
    second: Tensor | None = None
    sums: Tensor | None = None
    before: Tensor | None = None
    step: float = 0.0


class FitView(NamedTuple):
    """A view of a frame's fit.

    Args:
        viewport: the camera.
        picture: ``[H, W, 3]`` uint8.
        mask: ``[H, W]`` bool, the pixels that count; None for all.
        tiles: those that are drawn.
        changed: those that are drawn in visits without tiles at rest.
        gains: ``[3]`` the camera's correction of colours.
        biases: ``[3]``.
        background: ``[3]``; None for black.
        image: ``[H, W, 3]``, drawn into.
        static: Gaussians that are not trained.
    """

    viewport: Viewport
    picture: Tensor
    mask: Tensor | None
    tiles: TileSelection
    changed: TileSelection
    gains: Tensor
    biases: Tensor
    background: Tensor | None
    image: Tensor
    static: Gaussians


class LossFactors(NamedTuple):
    """Weights of the loss.

    Args:
        l1: of the mean absolute difference.
        ssim: of 1 - SSIM.
        volume: of the product of a Gaussian's scales.
        mean_volume: the mean of these products, not their sum.
        rate: of a bit of changes.
        smoothness: of the mean difference of displacements from the neighbours.
        pixel: unit of displacements.
        slack: see ``reference_losses.neighbour_difference``.
    """

    l1: float
    ssim: float
    volume: float
    mean_volume: bool
    rate: float = 0.0
    smoothness: float = 0.0
    pixel: float = 1.0
    slack: float = 0.0


class FitPlan(NamedTuple):
    """The iterations, ``I`` of them, counted from 0.

    Args:
        order: ``[I]`` int32, the view of each.
        rests: ``[I]`` bool: only the view's ``changed`` tiles are drawn.
        rates: ``[I, FIT_LEAVES]`` float64 learning rates.
        mean_from: the first iteration whose values are summed.
        errors_from: the first one whose squared error is computed.
        betas: of Adam.
        eps: of Adam.
        terms: ``[I, 5]`` results: L1, 1 - SSIM, volume, smoothness, and the loss: their weighted sum plus the rate
            term.
        squared_errors: ``[I]`` float64 results: mean squared error of the view's picture in its ``tiles``.
    """

    order: Tensor
    rests: Tensor
    rates: Tensor
    mean_from: int
    errors_from: int
    betas: tuple[float, float]
    eps: float
    terms: Tensor
    squared_errors: Tensor


class FitFrame(NamedTuple):
    """Iterations of a frame in which only anchors and free Gaussians are trained.

    Args:
        leaves: ``FIT_LEAVES`` tensors; None for appearance that the scene lacks.
        mlps: of the scene.
        basis: ``[R, D]`` of appearance; None without it.
        distance_input: whether the distance to the camera is an input of the MLPs.
        anchor_intervals: ``[M]`` sampling intervals; None: the low-pass is that of the picture.
        free_intervals: ``[F]``, as ``anchor_intervals``.
        views: the views.
        start: ``[M, 3]`` positions from which displacements are counted; None without smoothness.
        neighbours: ``[M, N]`` int64 anchors that each is compared with.
        shares: ``[M, N]`` their weights.
        factors: weights of the loss.
        plan: the iterations.
    """

    leaves: Sequence[FitLeaf | None]
    mlps: MLPWeights
    basis: Tensor | None
    distance_input: bool
    anchor_intervals: Tensor | None
    free_intervals: Tensor | None
    views: Sequence[FitView]
    start: Tensor | None
    neighbours: Tensor | None
    shares: Tensor | None
    factors: LossFactors
    plan: FitPlan
