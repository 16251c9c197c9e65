# SPDX-License-Identifier: Apache-2.0
"""What every fit of plain Gaussians does in every iteration: draw, compare, step."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from structgstream.scene.color import CameraColor
from structgstream.scene.render import Rendering, draw
from structgstream.training.optim import BETAS
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View


@dataclass
class Leaves:
    """Named leaf tensors and Adam's state of each.

    Args:
        backend: what steps.
        values: float32 leaves that collect gradients.
        eps: Adam's.
    """

    backend: Backend
    values: dict[str, Tensor]
    eps: float
    _first: dict[str, Tensor] = field(default_factory=dict)
    _second: dict[str, Tensor] = field(default_factory=dict)
    _steps: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Mapping[str, Tensor], *, backend: Backend, eps: float) -> "Leaves":
        """Copies of ``values``, ready to be optimised."""
        return cls(
            backend, {name: value.detach().clone().contiguous().requires_grad_() for name, value in values.items()}, eps
        )

    def step(self, gradients: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        """One step of Adam for every leaf with a gradient and a positive rate."""
        for name, gradient in gradients.items():
            if rates[name] <= 0.0:
                continue
            value = self.values[name]
            if name not in self._steps:
                self._first[name] = torch.zeros_like(value, requires_grad=False)
                self._second[name] = torch.zeros_like(value, requires_grad=False)
            self._steps[name] = self._steps.get(name, 0) + 1
            self.backend.adam_step(
                value.detach(),
                gradient,
                self._first[name],
                self._second[name],
                lr=rates[name],
                step=self._steps[name],
                betas=BETAS,
                eps=self.eps,
            )

    def replace_rows(self, added: Mapping[str, Tensor], *, keep: Tensor) -> None:
        """Keep the rows of the mask ``keep`` and append ``added``, whose Adam state is zero."""
        for name, rows in added.items():
            kept = self.values[name].detach()[keep]
            self.values[name] = torch.cat([kept, rows.detach()]).contiguous().requires_grad_()
            for state in (self._first, self._second):
                if name in state:
                    old = state[name][keep]
                    state[name] = torch.cat([old, old.new_zeros(rows.shape)])

    def replace_values(self, name: str, value: Tensor) -> None:
        """Put ``value`` in place of the leaf and forget its Adam state."""
        self.values[name] = value.detach().clone().contiguous().requires_grad_()
        for state in (self._first, self._second):
            if name in state:
                state[name] = torch.zeros_like(value)


@dataclass(frozen=True)
class PictureLoss:
    """0.8 L1 + 0.2 (1 - SSIM) of one view, and the rendering it was computed from."""

    total: Tensor
    rendering: Rendering
    gains: Tensor
    biases: Tensor

    def psnr(self, view: View) -> float:
        """PSNR of the clamped rendering, as the camera would have recorded it, dB."""
        with torch.no_grad():
            image = (self.rendering.image * self.gains + self.biases).clamp(0.0, 1.0)
            error = (image - view.image.to(image) / 255.0).square().mean()
        return -10.0 * math.log10(max(float(error), 1e-10))


SSIM_WEIGHT = 0.2  # 3DGS; L1 has the rest.


def picture_loss(
    gaussians: Gaussians,
    view: View,
    color: CameraColor,
    *,
    backend: Backend,
    track_screen: bool,
    watch: Stopwatch,
) -> PictureLoss:
    """Draw ``gaussians`` as ``view`` sees them and compare with its picture (3DGS's loss)."""
    with watch.stage("rasterise"):
        rendering = draw(gaussians, view.camera, backend, track_screen=track_screen)
    with watch.stage("loss"):
        gains, biases = color.gains[view.index], color.biases[view.index]
        if gains.requires_grad:
            l1, ssim = backend.l1_ssim(rendering.image * gains + biases, view.image)
        else:
            l1, ssim = backend.l1_ssim(rendering.image, view.image, gains=gains, biases=biases)
        return PictureLoss((1.0 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1.0 - ssim), rendering, gains, biases)


def gradients_of(
    loss: PictureLoss, values: Mapping[str, Tensor], watch: Stopwatch
) -> tuple[dict[str, Tensor], Tensor | None]:
    """Gradients of the leaves that the view touched, and of screen positions ``[N, 2]`` if they were tracked."""
    screen = loss.rendering.screen_offsets
    names = [name for name, value in values.items() if value.numel()]
    inputs = [values[name] for name in names]
    with watch.stage("backward"):
        found = torch.autograd.grad(loss.total, [*inputs, screen] if screen is not None else inputs, allow_unused=True)
    by_name = {name: grad for name, grad in zip(names, found, strict=False) if grad is not None}
    return by_name, found[-1] if screen is not None else None


class LastPsnr:
    """Mean PSNR over the last ``views`` of ``iterations``."""

    def __init__(self, iterations: int, views: int) -> None:
        self._from = iterations - views
        self._values: list[float] = []

    def add(self, iteration: int, loss: PictureLoss, view: View) -> None:
        """Note one view's, if it is among the last."""
        if iteration > self._from:
            self._values.append(loss.psnr(view))

    @property
    def mean(self) -> float:
        """In dB, NaN before any view."""
        return sum(self._values) / len(self._values) if self._values else math.nan
