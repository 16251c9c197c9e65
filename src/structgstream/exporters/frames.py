# SPDX-License-Identifier: Apache-2.0
"""Bakes frames of a stream and writes them one by one."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from structgstream.cameras import Camera
from structgstream.codec.reader import StreamReader
from structgstream.errors import StreamError
from structgstream.exporters.bake import BakingConfig, bake, with_low_pass
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.exporters.formats import Format, FrameOptions
from structgstream.exporters.write import open_output
from structgstream.kernels.backend import Backend
from structgstream.scene.render import Drawable, render
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device


@dataclass(frozen=True)
class BakingLoss:
    """How well baked Gaussians show what the stream shows, PSNR in dB over all pixels of the cameras.

    Args:
        training: at the training cameras.
        held_out: at the held-out cameras; None without any.
    """

    training: float
    held_out: float | None


@dataclass(frozen=True)
class WrittenFrame:
    """One written frame.

    Args:
        path: the file that has it, complete when all frames are written.
        gaussians: number of its Gaussians.
        loss: of the first frame: what was lost; None for the others.
    """

    path: Path
    gaussians: int
    loss: BakingLoss | None


def write_frames(
    reader: StreamReader,
    numbers: Sequence[int],
    output: Path,
    *,
    format: Format,
    backend: Backend,
    options: FrameOptions | None = None,
) -> Iterator[WrittenFrame]:
    """Bakes frames for the training cameras and writes each in the units of the capture.

    Args:
        reader: the stream.
        numbers: numbers of the frames; a single one if ``output`` is a file for one frame.
        output: a file, or a folder for ``frame_000000.ply`` and so on (``write.open_output``).
        format: format of the files.
        backend: evaluates the MLPs.
        options: what is fitted and left out; None for the defaults.

    Raises:
        StreamError: a frame is lost, or the options leave no Gaussian.
        StorageError: a file cannot be written.
        MissingExtraError: a package of the format is not installed.
    """
    options = options or FrameOptions()
    baking = replace(BakingConfig(), degree=options.baked_degree(format))
    header = reader.header
    cameras = [header.camera(name) for name in header.rig.training]
    with open_output(output, format, fps=header.fps, options=options) as write:
        for number in numbers:
            scene = on_device(reader.scene(number), backend.device)
            baked = bake(scene, cameras, backend, baking=baking)
            loss = baking_loss(scene, baked, reader, backend) if number == numbers[0] else None
            if options.low_pass and scene.sampling is not None:
                baked = with_low_pass(baked, scene.sampling, options.low_pass)
            plain = selected(baked.in_capture_units(header.similarity), options)
            yield WrittenFrame(write(number, plain), len(plain), loss)


def selected(gaussians: BakedGaussians, options: FrameOptions) -> BakedGaussians:
    """The Gaussians inside the box and above the opacity of ``options``, and of these the most important.

    Raises:
        StreamError: none is left.
    """
    good = gaussians.opacities >= options.min_opacity
    if options.box is not None:
        low, high = gaussians.means.new_tensor(options.box).reshape(2, 3)
        good &= ((gaussians.means >= low) & (gaussians.means <= high)).all(1)
    if not good.any():
        raise StreamError(
            f"--crop and --min-opacity leave none of {len(gaussians)} Gaussians; the box is in units of the capture."
        )
    found = gaussians if good.all() else gaussians.select(good)
    if options.max_splats is None or len(found) <= options.max_splats:
        return found
    return found.select(found.by_importance()[: options.max_splats].sort().values)


def baking_loss(scene: Scene, baked: BakedGaussians, reader: StreamReader, backend: Backend) -> BakingLoss:
    """Compares pictures of ``baked``, before ``with_low_pass``, with those of ``scene`` at the stream's cameras."""
    header = reader.header
    training, held_out = ([header.camera(n) for n in names] for names in (header.rig.training, header.rig.testing))
    return BakingLoss(
        pictures_psnr(scene, baked, training, backend),
        pictures_psnr(scene, baked, held_out, backend) if held_out else None,
    )


def pictures_psnr(one: Drawable, other: Drawable, cameras: Sequence[Camera], backend: Backend) -> float:
    """PSNR, dB, of all pixels that ``cameras`` see of two models, in the units of both."""
    errors, pixels = 0.0, 0
    with torch.no_grad():
        for camera in cameras:
            pictures = [render(model, camera, backend).image.clamp(0.0, 1.0) for model in (one, other)]
            errors += float((pictures[0] - pictures[1]).double().square().sum())
            pixels += pictures[0].numel()
    return -10.0 * math.log10(max(errors / pixels, 1e-12))
