# SPDX-License-Identifier: Apache-2.0
"""The loss of a view (paper, equations for L, L_vol, L_init and L_dist) and its view-space gradients.

Note [View-space units]
~~~~~~~~~~~~~~~~~~~~~~~
A rasteriser's ``screen_offsets`` are pixels. The thresholds of the literature (0.0002 for growing, the paper's
tau_grad = 0.001) are in normalised device coordinates, which span 2 over a picture: a gradient per pixel times half the
picture's size. This module is the only place that converts.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Self, TypeVar

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import StructuredGaussians
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.render import Rendering, draw
from structgstream.scene.scene import Scene
from structgstream.training.residuals import recorded
from structgstream.training.result import Stopwatch
from structgstream.training.views import View, blackened


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms; terms other than L1 and SSIM are not computed if their weight is zero."""

    l1: float = 1.0
    """On the mean absolute difference (paper: 1; Scaffold-GS: 0.8)."""
    ssim: float = 0.2
    """On 1 - SSIM, the paper's lambda_SSIM (0.2)."""
    volume: float = 0.01
    """On the product of each drawn Gaussian's scales, the paper's lambda_vol (0.01)."""
    volume_reduction: Literal["mean", "sum"] = "mean"
    """Reduction of L_vol: the paper's equation is a sum, Scaffold-GS takes the mean (docs/method.md)."""


@dataclass(frozen=True)
class InitialLossWeights(LossWeights):
    """Weights in frame 0, which alone has L_dist."""

    offset_distance: float = 0.005
    """On L_dist, the paper's lambda_dist (0.005)."""
    offset_distance_reduction: Literal["mean", "sum"] = "mean"
    """Reduction of L_dist: the paper's equation is a sum over anchors and offsets."""


def volume(scales: Tensor, opacities: Tensor, *, reduction: Literal["mean", "sum"], backend: Backend) -> Tensor:
    """L_vol: the products of the three scales ``[N, 3]`` of each Gaussian, summed or averaged.

    The sum is over all ``N``; a mean divides it by the number of opacities ``[N]`` above zero. Gaussians that dropout
    (``PerturbationConfig``) sets to opacity 0 keep their scales, and so stay in the sum.
    """
    total, drawn = backend.volume(scales, opacities)
    return total / drawn.clamp(min=1) if reduction == "mean" else total


def offset_distance(
    anchors: AnchorCloud, *, voxel_size: float, weights: InitialLossWeights, backend: Backend
) -> Tensor:
    """L_dist: penalty on offsets of Gaussians from their anchors beyond two voxels.

    theta(x) x is a hinge: of each component of O * l_v only the part above ``2 * voxel_size`` (the paper's 2 eps)
    counts.
    """
    total = backend.excess(anchors.offsets, anchors.log_offset_scales, 2.0 * voxel_size)
    return total / max(1, anchors.offsets.numel()) if weights.offset_distance_reduction == "mean" else total


LossT = TypeVar("LossT", bound="Loss")


@dataclass(frozen=True)
class Loss:
    """A loss to minimise.

    Args:
        total: ``[]`` the weighted sum.
        terms: each term ``[]`` by name, without its weight.
    """

    total: Tensor
    terms: dict[str, Tensor]

    @property
    def screen_offsets(self) -> Tensor | None:
        """``[N, 2]`` offsets whose gradient is the view-space gradient; None if it is not tracked."""
        return None

    def detached(self) -> Self:
        """The same loss without a gradient graph, of which nothing may stay alive when the next one is recorded: torch
        keeps what gathers a leaf's gradients, and on which stream, as long as any graph has it."""
        terms = {name: term.detach() for name, term in self.terms.items()}
        return replace(self, total=self.total.detach(), terms=terms)


def with_term(loss: LossT, name: str, value: Tensor, *, weight: float) -> LossT:
    """The same loss with another term."""
    return replace(loss, total=loss.total + weight * value, terms={**loss.terms, name: value})


@dataclass(frozen=True)
class ViewLoss(Loss):
    """The loss of one view and the rendering it was computed from, with the colour correction of its camera."""

    rendering: Rendering
    gains: Tensor
    biases: Tensor
    active: ActiveTiles | None

    @property
    def screen_offsets(self) -> Tensor | None:
        """``[N, 2]`` of the drawn Gaussians, pixels; None if they were not tracked."""
        return self.rendering.screen_offsets

    def detached(self) -> Self:
        found = super().detached()
        return replace(
            found, rendering=self.rendering.detached(), gains=self.gains.detach(), biases=self.biases.detach()
        )

    def squared_error(self, view: View) -> Tensor:
        """Mean squared error ``[]`` of the clamped rendering against the picture, over the drawn pixels that count."""
        rendered = self.rendering.image
        tiles = None if self.active is None else self.active.tiles
        masks = [view.mask, None if tiles is None else tiles.pixels()]
        inside = [mask for mask in masks if mask is not None]
        with torch.no_grad():
            corrected = blackened(recorded(rendered, self.gains, self.biases).clamp_(0.0, 1.0), view.mask)
            truth = view.colors
            if tiles is not None:
                corrected = tiles.choose(corrected, truth)
            total = (corrected - truth).square_().sum()
            if not inside:
                return total / max(truth.numel(), 1)
            # The number of pixels stays a tensor: on a GPU the host would have to wait for it.
            return total / (3.0 * torch.stack(inside).all(0).sum().clamp(min=1.0))


@dataclass(frozen=True)
class SceneLoss(ViewLoss):
    """The loss of one view of a scene.

    Args:
        structured: the Gaussians of its anchors.
        unperturbed: all its Gaussians before perturbation.
    """

    structured: StructuredGaussians
    unperturbed: Gaussians

    def detached(self) -> Self:
        structured = replace(self.structured, gaussians=self.structured.gaussians.detached())
        return replace(super().detached(), structured=structured, unperturbed=self.unperturbed.detached())


def picture_loss(
    gaussians: Gaussians,
    view: View,
    color: CameraColor,
    *,
    backend: Backend,
    weights: LossWeights,
    track_screen: bool,
    watch: Stopwatch,
    active: ActiveTiles | None = None,
    background: Tensor | None = None,
) -> ViewLoss:
    """Draw ``gaussians`` for ``view`` and compare with its picture, or with the tiles of ``active``.

    Args:
        gaussians: the drawable set.
        view: the picture.
        color: correction of the training cameras.
        backend: the compute back-end.
        weights: of L1 and of 1 - SSIM; the other weights are not used here.
        track_screen: keep the view-space positional gradient.
        watch: gets the seconds of stages ``rasterise`` and ``loss``.
        active: see ``scene.render.draw``.
        background: ``[3]`` background colour; None for black.
    """
    with watch.stage("rasterise"):
        rendering = draw(
            gaussians, view.camera, backend, track_screen=track_screen, active=active, background=background
        )
    with watch.stage("loss"):
        image, tiles = rendering.image, None if active is None else active.tiles
        gains, biases = color.gains[view.index], color.biases[view.index]
        if view.mask is not None:  # Note [Masked pixels]
            l1, ssim = backend.l1_ssim(blackened(recorded(image, gains, biases), view.mask), view.image, tiles=tiles)
        elif gains.requires_grad:
            l1, ssim = backend.l1_ssim(recorded(image, gains, biases), view.image, tiles=tiles)
        else:  # The loss kernel applies a constant correction at no cost.
            l1, ssim = backend.l1_ssim(image, view.image, gains=gains, biases=biases, tiles=tiles)
        terms = {"l1": l1, "ssim": 1.0 - ssim}
        total = weights.l1 * l1 + weights.ssim * terms["ssim"]
    return ViewLoss(total, terms, rendering, gains, biases, active)


def view_loss(
    scene: Scene,
    view: View,
    *,
    backend: Backend,
    weights: LossWeights,
    track_screen: bool,
    watch: Stopwatch,
    active: ActiveTiles | None = None,
    perturbation: Callable[[Gaussians], Gaussians] | None = None,
    background: Tensor | None = None,
) -> SceneLoss:
    """Render ``view`` and compare it with its picture, or the tiles of ``active`` (paper, equation for L).

    Optionally the Gaussians are perturbed by ``perturbation``, and ``background`` ``[3]`` replaces the scene's
    environment.
    """
    with watch.stage("generate"):
        tiles = None if active is None else active.tiles
        structured = scene.structured(view.camera, backend, tiles=tiles)
        unperturbed = scene.with_free_gaussians(structured)
        gaussians = unperturbed if perturbation is None else perturbation(unperturbed)
    loss = picture_loss(
        gaussians,
        view,
        scene.camera_color,
        backend=backend,
        weights=weights,
        track_screen=track_screen,
        watch=watch,
        active=active,
        background=scene.background(view.camera) if background is None else background,
    )
    with watch.stage("loss"):
        if weights.volume:
            scales, opacities = gaussians.scales, gaussians.opacities
            value = volume(scales, opacities, reduction=weights.volume_reduction, backend=backend)
            loss = with_term(loss, "volume", value, weight=weights.volume)
    return SceneLoss(**vars(loss), structured=structured, unperturbed=unperturbed)


class GradientStatistics:
    """Sum and count of the gradient norm for each of ``slots`` ids (Note [Ids])."""

    def __init__(self, slots: int, device: torch.device) -> None:
        self.total = torch.zeros(slots, device=device)
        self.count = torch.zeros(slots, device=device)

    def add(self, rendering: Rendering, gradient: Tensor) -> None:
        """Add one rendering's ``screen_offsets`` gradient ``[N, 2]`` (pixels) for the Gaussians that were drawn."""
        height, width = rendering.alpha.shape
        x, y = gradient.unbind(1)
        length = ((0.5 * width * x).square_() + (0.5 * height * y).square_()).sqrt_()
        drawn = (rendering.radii > 0).to(length)
        # An id occurs once a rendering, so sums repeat bit for bit.
        ids = rendering.gaussians.ids
        self.total.scatter_add_(0, ids, length.mul_(drawn))
        self.count.scatter_add_(0, ids, drawn)

    def mean(self) -> Tensor:
        """Mean gradient norm of each slot, ``[slots]`` in NDC; 0 if it was never drawn."""
        return self.total / self.count.clamp(min=1.0)
