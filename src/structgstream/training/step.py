# SPDX-License-Identifier: Apache-2.0
"""One view's loss: what both kinds of frame do in every iteration."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels.anchor_types import StructuredGaussians
from structgstream.kernels.backend import Backend
from structgstream.scene.focus import Focus
from structgstream.scene.render import Rendering, draw
from structgstream.scene.scene import Scene
from structgstream.scene.state import ParameterName
from structgstream.training.losses import LossWeights, offset_distance, volume
from structgstream.training.parameters import Parameters
from structgstream.training.solidity import depth_spread
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View


@dataclass(frozen=True)
class ViewLoss:
    """The loss of one view and what it was computed from."""

    total: Tensor
    terms: dict[str, Tensor]
    rendering: Rendering
    gains: Tensor
    biases: Tensor
    structured: StructuredGaussians
    focus: Focus | None

    @property
    def image(self) -> Tensor:
        """The rendering as the camera would have recorded it: what was compared, ``[H, W, 3]``."""
        return self.rendering.image * self.gains + self.biases

    def squared_error(self, view: View) -> Tensor:
        """Mean squared error of the clamped rendering against the picture, where it was drawn, ``[]``."""
        with torch.no_grad():
            squares = (self.image.clamp(0.0, 1.0) - view.image.to(self.image) / 255.0).square()
            if self.focus is None:
                return squares.mean()
            inside = self.focus.tiles.pixels()[..., None].to(squares)
            return (squares * inside).sum() / (3.0 * inside.sum())


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
    disturbed: Callable[[Gaussians], Gaussians] | None = None,
    background: Tensor | None = None,
    seen_from: Tensor | None = None,
    spread_weight: float = 0.0,
    spread_scale: float = 0.5,
) -> ViewLoss:
    """Render ``view`` and compare it with its picture (paper, equations for L and L_init), or what ``focus`` names.

    What is drawn is ``disturbed``, if that is given, and looks as from ``seen_from`` ``[3]``, before ``background``
    ``[3]`` instead of the scene's environment. With a ``spread_weight`` the spread of the undisturbed depth counts too,
    drawn in ``spread_scale`` of the picture's size.
    """
    with watch.stage("generate"):
        tiles = None if focus is None else focus.tiles
        structured = scene.structured(view.camera, backend, tiles=tiles, seen_from=seen_from)
        calm = scene.dressed(structured)
        gaussians = calm if disturbed is None else disturbed(calm)
    with watch.stage("rasterise"):
        behind = scene.background(view.camera) if background is None else background
        rendering = draw(gaussians, view.camera, backend, track_screen=track_screen, focus=focus, background=behind)
    with watch.stage("loss"):
        image = rendering.image
        gains, biases = scene.camera_color.gains[view.index], scene.camera_color.biases[view.index]
        if gains.requires_grad:
            l1, ssim = backend.l1_ssim(image * gains + biases, view.image, tiles=tiles)
        else:  # A constant correction costs nothing inside the loss.
            l1, ssim = backend.l1_ssim(image, view.image, gains=gains, biases=biases, tiles=tiles)
        terms = {"l1": l1, "ssim": 1.0 - ssim}
        total = weights.l1 * l1 + weights.ssim * terms["ssim"]
        if weights.volume:
            terms["volume"] = volume(
                gaussians.scales, gaussians.opacities, reduction=weights.volume_reduction, backend=backend
            )
            total = total + weights.volume * terms["volume"]
        if weights.offset_distance:
            terms["offset_distance"] = offset_distance(
                scene.anchors, voxel_size=voxel_size, weights=weights, backend=backend
            )
            total = total + weights.offset_distance * terms["offset_distance"]
    if spread_weight:
        with watch.stage("rasterise"):
            terms["depth_spread"] = depth_spread(calm, view.camera, scale=spread_scale, backend=backend)
            total = total + spread_weight * terms["depth_spread"]
    return ViewLoss(total, terms, rendering, gains, biases, structured, focus)


def gradients_of(
    loss: ViewLoss, parameters: Parameters, watch: Stopwatch
) -> tuple[dict[ParameterName, Tensor], Tensor | None]:
    """Gradients of the trained parameters, and of the screen positions ``[N, 2]`` in pixels when they were tracked.

    A parameter that the view did not touch has no entry; where nothing is drawn there is none at all.
    """
    if not loss.total.requires_grad:
        return {}, None
    names = parameters.trained
    inputs = [parameters.values[name] for name in names]
    screen = loss.rendering.screen_offsets
    with watch.stage("backward"):
        found = torch.autograd.grad(loss.total, [*inputs, screen] if screen is not None else inputs, allow_unused=True)
    by_name: dict[ParameterName, Tensor] = {
        name: grad for name, grad in zip(names, found, strict=False) if grad is not None
    }
    return by_name, found[-1] if screen is not None else None


class LastPass:
    """Mean loss terms and PSNR over the last pass through the cameras. Numbers are read when they are asked for."""

    def __init__(self) -> None:
        self._terms: dict[int, dict[str, Tensor]] = {}
        self._squared_errors: dict[int, Tensor] = {}

    def add(self, loss: ViewLoss, view: View) -> None:
        """Note one view's result, in place of what was noted of it before."""
        self._squared_errors[view.index] = loss.squared_error(view)
        self._terms[view.index] = {name: value.detach() for name, value in loss.terms.items()}

    @property
    def psnr(self) -> float:
        """Mean over views of the PSNR in dB, NaN before any view."""
        values = [-10.0 * math.log10(max(float(error), 1e-10)) for error in self._squared_errors.values()]
        return sum(values) / len(values) if values else math.nan

    @property
    def terms(self) -> dict[str, float]:
        """Mean of each loss term."""
        names = dict.fromkeys(
            name for terms in self._terms.values() for name in terms
        )  # Not every view has every term.
        by_name = {name: [terms[name] for terms in self._terms.values() if name in terms] for name in names}
        return {name: float(torch.stack(values).mean()) for name, values in by_name.items()}
