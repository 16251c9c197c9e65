# SPDX-License-Identifier: Apache-2.0
"""The training pictures of one frame as tensors, and their random order in training."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, islice

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.frames import MultiViewFrame


@dataclass(frozen=True)
class View:
    """One training picture.

    Args:
        index: row of the camera in the rig's training cameras (and so in the colour correction).
        camera: in scene units.
        image: ``[H, W, 3]`` uint8.
    """

    index: int
    camera: Camera
    image: Tensor
    _reduced: "dict[float, View]" = field(default_factory=dict, repr=False, compare=False)

    def reduced(self, scale: float) -> "View":
        """The view with its picture reduced by ``scale`` (area average) and its camera resized; cached."""
        if scale == 1.0:
            return self
        if scale not in self._reduced:
            self._reduced[scale] = reduced(self, scale)
        return self._reduced[scale]

    @property
    def colors(self) -> Tensor:
        """The picture in 0 ... 1, ``[H, W, 3]`` float32."""
        return self.image.float() / 255.0


def training_views(frame: MultiViewFrame, rig: CameraRig, device: torch.device) -> list[View]:
    """The frame's training views in rig order; held-out pictures are not read."""
    return [View(i, rig[name], torch.from_numpy(frame.images[name]).to(device)) for i, name in enumerate(rig.training)]


def reduced(view: View, scale: float) -> View:
    """The view with its picture reduced by ``scale`` (area average) and its camera resized."""
    width, height = (max(1, round(size * scale)) for size in (view.camera.width, view.camera.height))
    pixels = view.image.permute(2, 0, 1)[None].float()
    small = area_mean(pixels, (height, width))
    image = small[0].permute(1, 2, 0).round().to(torch.uint8).contiguous()
    return View(view.index, view.camera.resized(width, height), image)


def area_mean(planes: Tensor, size: tuple[int, int]) -> Tensor:
    """``planes`` ``[1, C, H, W]`` averaged down to ``size``, h and w."""
    by = planes.shape[2] // size[0]
    if (by * size[0], by * size[1]) == tuple(planes.shape[2:]):  # Integer factors take a fifth of the time.
        return torch.nn.functional.avg_pool2d(planes, by)
    return torch.nn.functional.interpolate(planes, size=size, mode="area")


def shuffled_views(views: list[View], generator: torch.Generator) -> Iterator[View]:
    """Endless iterator over views: random without replacement, pass after pass (as Scaffold-GS)."""
    while True:
        for i in torch.randperm(len(views), generator=generator).tolist():
            yield views[i]


def coarse_to_fine(
    views: list[View], *, coarse_iterations: int, coarse_scale: float, generator: torch.Generator
) -> Iterator[View]:
    """Endless shuffled views, the first ``coarse_iterations`` of them reduced by ``coarse_scale``."""
    coarse = [reduced(view, coarse_scale) for view in views] if coarse_iterations else views
    return chain(islice(shuffled_views(coarse, generator), coarse_iterations), shuffled_views(views, generator))
