# SPDX-License-Identifier: Apache-2.0
"""How strong L_dist and L_vol are beside the picture in frame 0: ``python -m`` this module and a capture.

L_dist acts on the components of O * l_v beyond 2 eps. Every ``--every`` iterations the gradients by O of the printed
sum, times its weight, and of the other terms are compared on these components: the median of the ratio over those that
the view reaches, and the ratio of the norms. Other reductions divide the sum by a number that is counted here, too.
L_vol is compared likewise, by the scales of the drawn Gaussians. Frame 0 is trained as its preset says, whatever is
compared.
"""

import json
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
import tyro
from torch import Tensor

from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import select_backend
from structgstream.recorder import record
from structgstream.session.presets import preset_named
from structgstream.session.struct_gstream import stream_pipeline
from structgstream.training.frame0 import fit
from structgstream.training.losses import InitialLossWeights, SceneLoss
from structgstream.training.views import View
from structgstream_studies.experiments.captures import CapturePart


@dataclass(frozen=True)
class Options:
    """Compares the gradients of L_dist and L_vol with the picture's."""

    capture: tyro.conf.Positional[Path]
    preset: str = "paper-n3dv"
    held_out: tuple[str, ...] | None = None
    scale: float = 1.0
    start: int = 0
    every: int = 250
    """Iterations between two comparisons."""
    views: int = 8
    """Iterations in a row that are compared then, each with another view."""
    seed: int = 0


def compared(hooks: Any, loss: SceneLoss) -> dict[str, float]:
    """Counts of one iteration, and ratios of the printed sums' gradients, times their weights, to the picture's."""
    values, config = hooks.parameters.values, hooks.config
    offsets, anchors = values["anchor_offsets"], hooks.scene.anchors
    gaussians = loss.structured.gaussians
    everything, by_scales = torch.autograd.grad(loss.total, (offsets, gaussians.scales), retain_graph=True)
    total = hooks.backend.excess(anchors.offsets, anchors.log_offset_scales, 2.0 * config.voxel_size)
    (pull,) = torch.autograd.grad(total, offsets)
    weight = config.losses.offset_distance
    mean = config.losses.offset_distance_reduction == "mean"
    picture = everything - pull * weight / (offsets.numel() if mean else 1)
    beyond, drawn = pull != 0, int((gaussians.opacities > 0).sum())
    reached = beyond & (picture != 0)
    norms = [float(gradient[reached].norm()) for gradient in (weight * pull, picture)]
    return {
        "median_ratio": float((weight * pull[reached].abs() / picture[reached].abs()).median()),
        "norm_ratio": norms[0] / norms[1],
        "components": offsets.numel(),
        "beyond": int(beyond.sum()),
        "beyond_and_reached": int(reached.sum()),
        "anchors": len(anchors),
        "anchors_in_view": len(loss.structured.anchors),
        "drawn": drawn,
        "excess_voxels": float(total.detach()) / max(int(beyond.sum()), 1) / config.voxel_size,
    } | _volume_ratios(gaussians, by_scales, drawn, config.losses)


def _volume_ratios(
    gaussians: Gaussians, everything: Tensor, drawn: int, weights: InitialLossWeights
) -> dict[str, float]:
    """Of the printed sum of L_vol over the drawn Gaussians; ``everything`` is the loss's gradient by their scales."""
    x, y, z = gaussians.scales.detach().unbind(1)
    pull = weights.volume * torch.stack([y * z, x * z, x * y], 1) * (gaussians.opacities > 0)[:, None]
    picture = everything - (pull / max(drawn, 1) if weights.volume_reduction == "mean" else pull)
    reached = (pull != 0) & (picture != 0)
    return {
        "volume_median_ratio": float((pull[reached] / picture[reached].abs()).median()),
        "volume_norm_ratio": float(pull[reached].norm() / picture[reached].norm()),
    }


def main(options: Options) -> None:
    """Trains frame 0 and prints a line of JSON for each comparison: medians over its views."""
    config = replace(preset_named(options.preset), seed=options.seed)
    part = CapturePart(options.capture, options.held_out, options.scale, options.start, frames=1)
    found: dict[int, list[dict[str, float]]] = defaultdict(list)
    original = fit._FirstFrameHooks.loss  # pyright: ignore[reportPrivateUsage]

    def loss(self: Any, iteration: int, sample: View) -> SceneLoss:
        result = original(self, iteration, sample)
        place = -(-iteration // options.every) * options.every
        if place - iteration < options.views:
            found[place].append(compared(self, result))
        return result

    with TemporaryDirectory() as folder, patch.object(fit._FirstFrameHooks, "loss", loss):  # pyright: ignore
        run = record(
            Path(folder) / "frame0.sgs", part.open(), stream_pipeline(config), select_backend("cpu"), resume=False
        )
        for _ in run.reports:
            pass
    for iteration, views in found.items():
        print(json.dumps({"iteration": iteration} | {name: median(v[name] for v in views) for name in views[0]}))


if __name__ == "__main__":
    main(tyro.cli(Options))
