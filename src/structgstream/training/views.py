# SPDX-License-Identifier: Apache-2.0
"""The training pictures of one frame as tensors, and the order in which they are looked at."""

from collections.abc import Iterator
from dataclasses import dataclass, field

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
        """The view with its picture shrunk by ``scale`` (area average) and its camera to match; kept."""
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
    """The frame's training views in rig order; held-out pictures are not touched."""
    return [View(i, rig[name], torch.from_numpy(frame.images[name]).to(device)) for i, name in enumerate(rig.training)]


def reduced(view: View, scale: float) -> View:
    """The view with its picture shrunk by ``scale`` (area average) and its camera to match."""
    width, height = (max(1, round(size * scale)) for size in (view.camera.width, view.camera.height))
    pixels = view.image.permute(2, 0, 1)[None].float()
    small = torch.nn.functional.interpolate(pixels, size=(height, width), mode="area")
    image = small[0].permute(1, 2, 0).round().to(torch.uint8).contiguous()
    return View(view.index, view.camera.resized(width, height), image)


def shuffled_views(views: list[View], generator: torch.Generator) -> Iterator[View]:
    """Views without end: each once in random order, then again (random without replacement, as Scaffold-GS)."""
    while True:
        for i in torch.randperm(len(views), generator=generator).tolist():
            yield views[i]
