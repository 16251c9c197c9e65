# SPDX-License-Identifier: Apache-2.0
"""The loss of one view, computed in every iteration of every fit."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import StructuredGaussians
from structgstream.scene.color import CameraColor
from structgstream.scene.focus import Focus
from structgstream.scene.render import Rendering, draw
from structgstream.scene.scene import Scene
from structgstream.training.losses import LossWeights, offset_distance, volume
from structgstream.training.residuals import recorded
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View, blackened

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
    focus: Focus | None

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
        tiles = None if self.focus is None else self.focus.tiles
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
    focus: Focus | None = None,
    background: Tensor | None = None,
) -> ViewLoss:
    """Draw ``gaussians`` for ``view`` and compare with its picture, or with the tiles of ``focus``.

    Args:
        gaussians: the drawable set.
        view: the picture.
        color: correction of the training cameras.
        backend: the compute back-end.
        weights: of L1 and of 1 - SSIM; the other weights are not used here.
        track_screen: keep the view-space positional gradient.
        watch: gets the seconds of stages ``rasterise`` and ``loss``.
        focus: see ``scene.render.draw``.
        background: ``[3]`` background colour; None for black.
    """
    with watch.stage("rasterise"):
        rendering = draw(gaussians, view.camera, backend, track_screen=track_screen, focus=focus, background=background)
    with watch.stage("loss"):
        image, tiles = rendering.image, None if focus is None else focus.tiles
        gains, biases = color.gains[view.index], color.biases[view.index]
        if view.mask is not None:  # Note [Masked pixels]
            l1, ssim = backend.l1_ssim(blackened(image * gains + biases, view.mask), view.image, tiles=tiles)
        elif gains.requires_grad:
            l1, ssim = backend.l1_ssim(image * gains + biases, view.image, tiles=tiles)
        else:  # The loss kernel applies a constant correction at no cost.
            l1, ssim = backend.l1_ssim(image, view.image, gains=gains, biases=biases, tiles=tiles)
        terms = {"l1": l1, "ssim": 1.0 - ssim}
        total = weights.l1 * l1 + weights.ssim * terms["ssim"]
    return ViewLoss(total, terms, rendering, gains, biases, focus)


def view_loss(
    scene: Scene,
    view: View,
    *,
    backend: Backend,
    weights: LossWeights,
    voxel_size: float,
    track_screen: bool,
    watch: Stopwatch,
    focus: Focus | None = None,
    perturbation: Callable[[Gaussians], Gaussians] | None = None,
    background: Tensor | None = None,
    seen_from: Tensor | None = None,
) -> SceneLoss:
    """Render ``view`` and compare it with its picture, or the tiles of ``focus`` (paper, equations for L and L_init).

    Optionally the Gaussians are perturbed by ``perturbation``, view directions start at ``seen_from`` ``[3]``, and
    ``background`` ``[3]`` replaces the scene's environment.
    """
    with watch.stage("generate"):
        tiles = None if focus is None else focus.tiles
        structured = scene.structured(view.camera, backend, tiles=tiles, seen_from=seen_from)
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
        focus=focus,
        background=scene.background(view.camera) if background is None else background,
    )
    with watch.stage("loss"):
        if weights.volume:
            scales, opacities = gaussians.scales, gaussians.opacities
            value = volume(scales, opacities, reduction=weights.volume_reduction, backend=backend)
            loss = with_term(loss, "volume", value, weight=weights.volume)
        if weights.offset_distance:
            value = offset_distance(scene.anchors, voxel_size=voxel_size, weights=weights, backend=backend)
            loss = with_term(loss, "offset_distance", value, weight=weights.offset_distance)
    return SceneLoss(**vars(loss), structured=structured, unperturbed=unperturbed)
