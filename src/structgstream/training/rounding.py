# SPDX-License-Identifier: Apache-2.0
"""What will be sent, already while it is fitted: values on a grid.

Note [Bins]
~~~~~~~~~~~
A dynamic value is an integer bin times a step. What is fitted moves freely, what is drawn is rounded, and the gradient
passes the rounding as if it were not there (straight-through). Bins are absolute, so the difference of two frames'
bins is exact and nothing drifts.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.scene.state import PARAMETERS, ParameterName


class _RoundStraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, step: float) -> Tensor:
        return (value / step).round() * step

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return grads[0], None


def round_straight_through(value: Tensor, step: float) -> Tensor:
    """``value`` on the grid of ``step``; the gradient is that of ``value``."""
    return _RoundStraightThrough.apply(value, step)


# The quality multiplies a field of RoundingConfig by 2^(-quality * share); the share is 1 unless stated. What frame 0
# loses every later frame lacks, and its bytes come once: it follows by half. What is no step has a share of 0.
_HALF_SHARE = {"quality_share": 0.5}
_NO_STEP = {"quality_share": 0.0}


@dataclass(frozen=True)
class RoundingConfig:
    """How fine what is sent is, for a stream with the codec ``compact``."""

    position_pixels: float = 0.25
    """Step of positions, as seen by a typical camera at a typical distance: less cannot be seen."""
    log_scale_step: float = 0.02
    appearance_step: float = 1 / 16
    """In standard deviations of the features along a direction of the basis."""
    weight_step: float = 0.002
    """Of the weights of MLPs."""
    free_log_scale_step: float = 0.05
    free_quat_step: float = 1 / 64
    free_logit_opacity_step: float = 0.125
    free_color_step: float = 1 / 128
    first_noise_levels: float = field(default=0.5, metadata=_HALF_SHARE)
    """Noise that rounding frame 0 may add to the pictures: root of the mean square, in 8-bit levels."""
    first_weight_step: float = field(default=1 / 1024, metadata=_HALF_SHARE)
    """Of the weights of MLPs in frame 0."""
    rate_weight: float = field(default=1.8e-4, metadata=_NO_STEP)
    """Weight in the loss of the bits of a moving anchor."""
    free_priced: bool = field(default=False, metadata=_NO_STEP)
    """Whether a bit of a free Gaussian that was there before costs as much."""
    quality: float = field(default=0.0, metadata=_NO_STEP)
    """One knob over all of the above: 1 more makes every step half as large, and a bit a quarter as dear. Frame 0
    follows by half of that."""

    def resolved(self) -> "RoundingConfig":
        """The same, with the quality put into the other fields and itself 0."""
        shares = {f.name: f.metadata.get("quality_share", 1.0) for f in fields(self)}
        finer = {name: getattr(self, name) * 2.0 ** (-self.quality * share) for name, share in shares.items() if share}
        # Errors grow with the square of a step.
        return replace(self, **finer, rate_weight=self.rate_weight * 4.0**-self.quality, quality=0.0)

    def steps(self, pixel: float) -> dict[ParameterName, float]:
        """The step of everything that can change, by name; ``pixel`` is what one covers, in units of the scene."""
        plain = self.resolved()
        units = {"position_pixels": pixel}
        return {p.name: getattr(plain, p.step) * units.get(p.step, 1.0) for p in PARAMETERS if p.step}


def pixel_size(positions: Tensor, rig: CameraRig) -> float:
    """What a pixel covers at the median distance of what the median training camera sees, in units of the scene.

    Args:
        positions: ``[M, 3]`` of anchors.
        rig: in units of the scene.
    """
    sizes = []
    for name in rig.training:
        viewmat, K = rig[name].viewport(positions)[:2]
        points = positions @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = (points @ K.T)[:, :2] / points[:, 2:]
        size = pixels.new_tensor([rig[name].width, rig[name].height])
        seen = (points[:, 2] > rig[name].near) & ((pixels >= 0) & (pixels < size)).all(1)
        if seen.any():
            sizes.append(float(points[seen, 2].median() / K[0, 0]))
    return float(torch.tensor(sizes).median())
