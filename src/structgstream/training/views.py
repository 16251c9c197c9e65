# SPDX-License-Identifier: Apache-2.0
"""The training pictures of one frame as tensors, and their random order in training.

Note [Masked pixels]
~~~~~~~~~~~~~~~~~~~~
A pixel that a mask leaves out is treated as if it lay outside of the picture: both pictures are black there when they
are compared, as SSIM's window sees zeros beyond the border. So neither what the camera nor what the scene shows there
has any influence, on the loss or on its gradient. Losses stay means over all pixels, in which masked ones count as
equal, as tiles that are not drawn do: the weight of a pixel against regularisers, and the thresholds of
view-space gradients, then mean the same with and without a mask. Scores, shares and PSNR are over the pixels that
count. A pixel of a reduced picture counts if all of its pixels do.
"""

import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.cameras import Camera, CameraRig, enlargement
from structgstream.frames import MultiViewFrame

Item = TypeVar("Item")
Found = TypeVar("Found")

PROCESSOR_VIEWS = 4
"""Number of views that are computed together on the CPU, whose caches hold few pictures; with more threads than this,
one for each thread. On a GPU all are computed together, because the host has to queue every operation."""
MAX_PHASES = 8
"""Ratios of sizes whose pattern repeats after more pixels than this are left to torch."""


@dataclass(frozen=True)
class View:
    """One training picture.

    Args:
        index: row of the camera in the rig's training cameras (and so in the colour correction).
        camera: in scene units.
        image: ``[H, W, 3]`` uint8, black where ``mask`` is False.
        mask: ``[H, W]`` bool, the pixels that count (Note [Masked pixels]); None if all do.
    """

    index: int
    camera: Camera
    image: Tensor
    mask: Tensor | None = None
    _reduced: "dict[float, View]" = field(default_factory=dict, repr=False, compare=False)

    def reduced(self, scale: float) -> "View":
        """The view with its picture reduced by ``scale`` (area average) and its camera resized; cached."""
        return reduced_views([self], scale)[0]

    @property
    def enlargement(self) -> float:
        """How many of its pixels are one of a picture of the reference size (``cameras.enlargement``)."""
        return enlargement(self.camera.width, self.camera.height)

    @property
    def reference_area(self) -> float:
        """Number of its pixels at the reference size: in these, coverage is measured."""
        return self.camera.width * self.camera.height / self.enlargement**2

    def evidence(self, scale: float) -> "View":
        """The view reduced by ``scale`` and to the reference size, for measurements whose lengths are in pixels."""
        return self.reduced(scale / self.enlargement)

    @property
    def colors(self) -> Tensor:
        """The picture in 0 ... 1, ``[H, W, 3]`` float32."""
        return self.image.float() / 255.0


def training_views(frame: MultiViewFrame, rig: CameraRig, device: torch.device) -> list[View]:
    """The frame's training views in rig order, without absent cameras; held-out pictures are not read."""
    rows, names = {name: i for i, name in enumerate(rig.training)}, frame.showing(rig.training)
    # Torch does not take views that count backwards, as OpenCV's pictures[..., ::-1].
    images = [torch.from_numpy(np.ascontiguousarray(frame.images[name])) for name in names]
    if device.type != "cpu":
        images = in_groups(images, lambda image: image.shape, lambda same: torch.stack(same).to(device), device=device)
    return [_view(rows[n], rig[n], image, frame.masks.get(n)) for n, image in zip(names, images, strict=True)]


def _view(index: int, camera: Camera, image: Tensor, mask: NDArray[np.bool_] | None) -> View:
    if mask is None or mask.all():
        return View(index, camera, image)
    counts = torch.from_numpy(np.ascontiguousarray(mask)).to(image.device)
    return View(index, camera, blackened(image, counts), counts)


def blackened(picture: Tensor, mask: Tensor | None) -> Tensor:
    """``picture`` ``[..., 3]``, black where the mask ``[...]`` is False; None leaves it as it is."""
    return picture if mask is None else torch.where(mask[..., None], picture, 0)


def mean_of_counting(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean ``[...]`` of ``values`` ``[..., H, W]`` over the pixels of the mask, outside of which they are 0."""
    return values.mean((-2, -1)) if mask is None else values.sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)


def in_groups(
    items: Sequence[Item],
    group: Callable[[Item], Hashable],
    compute: Callable[[list[Item]], Iterable[Found]],
    *,
    device: torch.device,
) -> list[Found]:
    """``compute`` of the items of each group together, on the processor of a few at a time; its results are in the
    order of ``items``."""
    rows: dict[Hashable, list[int]] = {}
    for row, item in enumerate(items):
        rows.setdefault(group(item), []).append(row)
    most = max(PROCESSOR_VIEWS, torch.get_num_threads()) if device.type == "cpu" else max(len(items), 1)
    parts = [of_group[n : n + most] for of_group in rows.values() for n in range(0, len(of_group), most)]
    found = {row: one for part in parts for row, one in zip(part, compute([items[row] for row in part]), strict=True)}
    return [found[row] for row in range(len(items))]


def by_size(views: Sequence[View], compute: Callable[[list[View]], Iterable[Found]]) -> list[Found]:
    """``compute`` of the views of each picture size together, as arrays of pictures."""
    if not views:
        return []
    device = views[0].image.device
    return in_groups(views, lambda view: (view.image.shape, view.camera.near), compute, device=device)


def stacked_colors(views: Sequence[View]) -> Tensor:
    """The pictures of views of one size in 0 ... 1, ``[V, H, W, 3]`` float32."""
    return torch.stack([view.image for view in views]).float() / 255.0


def stacked_masks(views: Sequence[View]) -> Tensor | None:
    """The masks of views of one size, ``[V, H, W]``; None if all of their pixels count."""
    if all(view.mask is None for view in views):
        return None
    every = torch.ones(views[0].image.shape[:2], dtype=torch.bool, device=views[0].image.device)
    return torch.stack([every if view.mask is None else view.mask for view in views])


def reduced_views(views: Sequence[View], scale: float) -> list[View]:
    """:meth:`View.reduced` of each of ``views``."""
    if scale == 1.0:
        return list(views)
    missing = [view for view in views if scale not in view._reduced]
    for view, small in zip(missing, by_size(missing, lambda same: _reduced(same, scale)), strict=True):
        view._reduced[scale] = small
    return [view._reduced[scale] for view in views]


def evidence_views(views: Sequence[View], scale: float) -> list[View]:
    """:meth:`View.evidence` of each of ``views``."""
    return by_size(views, lambda same: reduced_views(same, scale / same[0].enlargement))


def _reduced(views: list[View], scale: float) -> Iterable[View]:
    cameras = [view.camera.scaled(scale) for view in views]
    size = (cameras[0].height, cameras[0].width)
    images, masks = _reduced_pictures(torch.stack([view.image for view in views]), size), stacked_masks(views)
    if masks is None:
        return [View(view.index, camera, image) for view, camera, image in zip(views, cameras, images, strict=True)]
    masks = area_mean(masks[:, None].float(), size)[:, 0] > 1.0 - 1e-4
    pictures = zip(views, cameras, blackened(images, masks), masks, strict=True)
    return [View(view.index, camera, image, mask) for view, camera, image, mask in pictures]


def _reduced_pictures(pictures: Tensor, size: tuple[int, int]) -> Tensor:
    """The bytes ``[V, H, W, 3]`` averaged down to ``size``, h and w."""
    count, height, width = pictures.shape[:3]
    factor = height // size[0]
    if factor > MAX_PHASES or (size[0] * factor, size[1] * factor) != (height, width):
        small = area_mean(pictures.permute(0, 3, 1, 2).float(), size)
        return small.permute(0, 2, 3, 1).round().to(torch.uint8).contiguous()
    # Whole blocks of pixels: sums of integers, in an eighth of the time.
    rows = torch.zeros(count, size[0], width, 3, dtype=torch.int16, device=pictures.device)
    for first in range(factor):
        rows += pictures[:, first::factor]
    total = torch.zeros(count, *size, 3, dtype=torch.int16, device=pictures.device)
    for first in range(factor):
        total += rows[:, :, first::factor]
    return (total.float() / factor**2).round().to(torch.uint8)


def area_mean(planes: Tensor, size: tuple[int, int]) -> Tensor:
    """``planes`` ``[N, C, H, W]`` averaged down to ``size``, h and w, as ``interpolate`` with mode ``area``: by adding
    strided rows and columns, which takes a seventh to a half of its time."""
    return _mean_along(_mean_along(planes, 2, size[0]), 3, size[1])


def dilated(values: Tensor, reach: int) -> Tensor:
    """The largest of ``values`` ``[..., H, W]`` in the square that reaches ``reach`` pixels beyond each, inside the
    picture; of masks, where any is True. By shifted maxima, which take a thirtieth of ``max_pool2d``'s time."""
    for dim in (-2, -1):
        found, size = values.clone(), values.shape[dim]
        for shift in range(1, min(reach, size - 1) + 1):
            for first, other in ((shift, 0), (0, shift)):
                part = found.narrow(dim, first, size - shift)
                torch.maximum(part, values.narrow(dim, other, size - shift), out=part)
        values = found
    return values


def _mean_along(planes: Tensor, dim: int, size: int) -> Tensor:
    """Means of the pixels along ``dim`` that each of ``size`` larger ones touches."""
    period = math.gcd(planes.shape[dim], size)
    pixels, outputs = planes.shape[dim] // period, size // period  # The pattern repeats after as many.
    if pixels == outputs:
        return planes
    if outputs > MAX_PHASES:
        shape = (size, planes.shape[3]) if dim == 2 else (planes.shape[2], size)
        return torch.nn.functional.interpolate(planes, size=shape, mode="area")
    every = tuple(slice(None) for _ in range(dim))
    phases = []
    for output in range(outputs):
        first, *others = range(output * pixels // outputs, -(-(output + 1) * pixels // outputs))
        total = sum((planes[*every, other::pixels] for other in others), start=planes[*every, first::pixels])
        phases.append(total / (1 + len(others)))
    return phases[0] if outputs == 1 else torch.stack(phases, dim + 1).flatten(dim, dim + 1)


def shuffled_views(views: list[View], generator: torch.Generator) -> Iterator[View]:
    """Endless iterator over views: random without replacement, pass after pass (as Scaffold-GS)."""
    while True:
        for i in torch.randperm(len(views), generator=generator).tolist():
            yield views[i]


def coarse_to_fine(
    views: list[View], stages: Sequence[tuple[int, float]], *, generator: torch.Generator
) -> Iterator[View]:
    """Endless shuffled views: for each stage its number of views, reduced by its scale, then whole ones."""
    small = (
        islice(shuffled_views([view.reduced(scale) for view in views], generator), count)
        for count, scale in stages
        if count > 0
    )
    return chain(chain.from_iterable(small), shuffled_views(views, generator))
