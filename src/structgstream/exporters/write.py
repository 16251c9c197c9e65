# SPDX-License-Identifier: Apache-2.0
"""Bakes frames of a stream and writes them: to a file, a folder, a zip, or a file of all frames.

Formats with all frames in one file are OpenUSD and ``.4dgs``; both have y up. OpenUSD has one prim
``ParticleField3DGaussianSplat`` (OpenUSD 26.03) with a time sample of each frame. Time codes count frames at the
stream's rate, which the stage has: they are frame numbers where no frame is left out. Scales and opacities are stored
as they are, spherical harmonics Gaussian by Gaussian, the constant coefficient first. An older library than 26.03
writes the same prim and attributes without knowing their schema.

In ``.4dgs`` (Apache-2.0, https://4dgs.dev) each Gaussian lives from its frame to the next. The library quantizes
positions, scales, rotations and colours within stated bounds, and coefficients above the constant one to 8 bits.
Gaussians of different frames are not linked, so nothing is predicted from frame to frame.
"""

import math
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from structgstream.atomic_files import atomic_file, atomic_write, give_name
from structgstream.cameras import Camera
from structgstream.codec.reader import StreamReader
from structgstream.errors import StorageError, StreamError, import_extra
from structgstream.exporters.bake import BakedGaussians, bake, with_low_pass
from structgstream.exporters.formats import FORMATS, SUFFIXES, Format, FrameOptions, is_one_file
from structgstream.exporters.ply import ply_bytes
from structgstream.exporters.web import glb_bytes, sog_bytes, splat_bytes, spz_bytes
from structgstream.harmonics import Y0
from structgstream.kernels.backend import Backend
from structgstream.scene.render import Drawable, render
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device

# pxr, which has no types, and fourdgs are optional packages.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

PRIM_TYPE = "ParticleField3DGaussianSplat"


class UsdFile:
    """Collects frames and writes them to one file."""

    def __init__(self, *, fps: float) -> None:
        """Begin a file. Raises MissingExtraError if usd-core is not installed."""
        import_extra("pxr", "export")
        from pxr import Sdf, Usd, UsdGeom

        self._stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(self._stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(self._stage, 1.0)
        self._stage.SetTimeCodesPerSecond(fps)
        self._stage.SetFramesPerSecond(fps)
        prim = self._stage.DefinePrim("/Splats", PRIM_TYPE)
        self._stage.SetDefaultPrim(prim)
        types = Sdf.ValueTypeNames
        attributes = {
            "positions": types.Point3fArray,
            "orientations": types.QuatfArray,
            "scales": types.Float3Array,
            "opacities": types.FloatArray,
            "radiance:sphericalHarmonicsCoefficients": types.Float3Array,
            "extent": types.Float3Array,
        }
        self._attributes = {name: prim.CreateAttribute(name, kind, custom=False) for name, kind in attributes.items()}
        self._degree = prim.CreateAttribute(
            "radiance:sphericalHarmonicsDegree", types.Int, False, Sdf.VariabilityUniform
        )
        self._fps = fps
        self._codes: list[float] = []

    def add(self, seconds: float, gaussians: BakedGaussians) -> None:
        """Add the frame presented at ``seconds``: OpenCV axes, in the units of the file."""
        from pxr import Vt

        gaussians = gaussians.y_up()
        reach = 3.0 * gaussians.scales.max(1, keepdim=True).values
        extent = torch.stack([(gaussians.means - reach).min(0).values, (gaussians.means + reach).max(0).values])
        samples: dict[str, Any] = {
            "positions": Vt.Vec3fArray.FromNumpy(_array(gaussians.means)),
            "orientations": Vt.QuatfArray.FromNumpy(_array(gaussians.quats[:, [1, 2, 3, 0]])),
            "scales": Vt.Vec3fArray.FromNumpy(_array(gaussians.scales)),
            "opacities": Vt.FloatArray.FromNumpy(_array(gaussians.opacities)),
            "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(_array(gaussians.sh.flatten(0, 1))),
            "extent": Vt.Vec3fArray.FromNumpy(_array(extent)),
        }
        code = round(seconds * self._fps, 6)
        for name, value in samples.items():
            self._attributes[name].Set(value, code)
        self._degree.Set(gaussians.degree)
        self._codes.append(code)

    def save(self, path: Path) -> None:
        """Write the file; its suffix says whether it is binary or text."""
        self._stage.SetStartTimeCode(self._codes[0])
        self._stage.SetEndTimeCode(self._codes[-1])
        self._stage.GetRootLayer().Export(str(path))


def _array(values: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.cpu().numpy(), np.float32)


class FourDgsFile:
    """Collects frames and writes them to one file."""

    def __init__(self, *, fps: float) -> None:
        """Begin a file. Raises MissingExtraError if fourdgs is not installed."""
        import_extra("fourdgs", "export")
        self._fps = fps
        self._frames: list[dict[str, np.ndarray]] = []
        self._seconds: list[float] = []  # presentation times of the frames
        self._degree = 0

    def add(self, seconds: float, gaussians: BakedGaussians) -> None:
        """Add the frame presented at ``seconds``: OpenCV axes, in the units of the file."""
        from fourdgs.quantization import SH_QUANT_HI, SH_QUANT_LO

        gaussians = gaussians.y_up()
        self._degree = gaussians.degree
        self._seconds.append(seconds)
        count = len(gaussians)
        rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1).cpu().numpy()
        color = (0.5 + Y0 * gaussians.sh[:, 0]).clamp(0.0, 1.0).cpu().numpy()
        self._frames.append(
            {
                "positions": gaussians.means.cpu().numpy(),
                "scales": gaussians.scales.cpu().numpy(),
                "rotations": gaussians.quats[:, [1, 2, 3, 0]].cpu().numpy(),
                "colors": np.concatenate([color, gaussians.opacities.cpu().numpy()[:, None]], axis=1),
                "sh": np.rint((rest - SH_QUANT_LO) / (SH_QUANT_HI - SH_QUANT_LO) * 255).clip(0, 255).astype(np.uint8),
                "motions": np.zeros((count, 3)),
                "sigma_t": np.full(count, np.inf),
            }
        )

    def save(self, path: Path) -> None:
        """Write the file."""
        from fourdgs import GaussianSet, WriteOptions, write

        starts = [seconds - self._seconds[0] for seconds in self._seconds]
        duration = starts[-1] + 1 / self._fps
        for frame, start, end in zip(self._frames, starts, [*starts[1:], duration], strict=True):
            begins = np.full(len(frame["positions"]), start)
            frame |= {"win_lo": begins, "win_hi": np.full_like(begins, end), "mu_t": begins}
        columns = {name: np.concatenate([frame[name] for frame in self._frames]) for name in self._frames[0]}
        exact = {"sh", "win_lo", "win_hi"}
        columns = {name: value if name in exact else value.astype(np.float32) for name, value in columns.items()}
        if not self._degree:
            columns.pop("sh")
        metadata = {"coordinate_system": "y-up-right-handed", "color_space": "srgb-rec709-display"}
        options = WriteOptions(library="structgstream", metadata=metadata)
        write(str(path), GaussianSet(**columns, sh_degree=self._degree), duration, options=options)


FORMAT_BYTES: Mapping[Format, Callable[[BakedGaussians, FrameOptions], bytes]] = {
    "ply": ply_bytes,
    "splat": splat_bytes,
    "spz": spz_bytes,
    "sog": sog_bytes,
    "glb": glb_bytes,
}
"""Formats with a file for each frame."""


class FramesFile(Protocol):
    """A file that contains all frames."""

    def add(self, seconds: float, gaussians: BakedGaussians) -> None: ...

    def save(self, path: Path) -> None: ...


FRAMES_FILES: Mapping[Format, Callable[..., FramesFile]] = {"usd": UsdFile, "4dgs": FourDgsFile}
"""Formats with one file for all frames."""
FrameWriter = Callable[[int, float, BakedGaussians], Path]
"""Writes a frame, given its number and its time in seconds, and returns the file that has it when the output is
complete."""


@contextmanager
def open_output(output: Path, format: Format, *, fps: float, options: FrameOptions) -> Iterator[FrameWriter]:
    """What writes frames to ``output``, which is complete at the end of the block.

    Args:
        output: a file for one frame; ``NAME.zip``; a file of all frames; or a folder for ``frame_000000.ply`` etc.

    Raises:
        ConfigError: the format does not support these Gaussians.
        StreamError: a value is not finite, or a scale is not positive.
        StorageError: a file cannot be written; an existing file is not affected.
        MissingExtraError: a package is not installed.
    """
    folder = output.is_dir()
    if FORMATS[format].all_frames:
        collected = FRAMES_FILES[format](fps=fps)
        if folder or SUFFIXES.get(output.suffix.lower().lstrip(".")) != format:
            output = output / f"frames.{format}"

        def collect(number: int, seconds: float, gaussians: BakedGaussians) -> Path:
            check_finite(gaussians)
            collected.add(seconds, gaussians)
            return output

        yield collect
        _save(collected, output)
    elif output.suffix.lower() == ".zip" and not folder:
        with atomic_file(output, new_folder=True) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:

            def add(number: int, seconds: float, gaussians: BakedGaussians) -> Path:
                check_finite(gaussians)
                entry = zipfile.ZipInfo(frame_name(number, format))  # with a fixed date
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, FORMAT_BYTES[format](gaussians, options))
                return output

            yield add
    else:
        single = is_one_file(output)
        yield lambda number, seconds, gaussians: write_gaussians(
            output if single else output / frame_name(number, format), gaussians, format=format, options=options
        )


def frame_name(number: int, format: Format) -> str:
    """Name of a frame's file: one prefix, so that editors see a sequence."""
    return f"frame_{number:06d}.{format}"


def write_gaussians(
    path: Path, gaussians: BakedGaussians, *, format: Format, options: FrameOptions | None = None
) -> Path:
    """Writes a file of ``gaussians``, in its units and OpenCV axes, atomically; returns ``path``. A missing folder is
    created. Raises errors as :func:`open_output`."""
    check_finite(gaussians)
    atomic_write(path, FORMAT_BYTES[format](gaussians, options or FrameOptions()), new_folder=True)
    return path


def _save(collected: FramesFile, output: Path) -> None:
    partial = output.with_name(f"{output.stem}.partial{output.suffix}")  # libraries go by the suffix
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        collected.save(partial)
        give_name(partial, output)
    except BaseException as error:
        with suppress(OSError):
            partial.unlink()
        if isinstance(error, OSError):
            raise StorageError(f"{output} cannot be written ({error.strerror or error}).") from error
        raise


def check_finite(gaussians: BakedGaussians) -> None:
    """Check that every value is finite and every scale is positive, because logarithms of scales are stored. Raises
    StreamError if they are not; the message names the values."""
    for field in fields(gaussians):
        values = getattr(gaussians, field.name)
        good = values.isfinite()
        if field.name == "scales":
            good &= values > 0.0
        if count := int((~good.reshape(len(gaussians), -1).all(1)).sum()):
            raise StreamError(
                f"The {field.name} of {count} of {len(gaussians)} Gaussians are infinite, zero or no numbers in the "
                "units of the capture, so nothing is exported; the stream's similarity or its scene is out of range: "
                "make it again from a capture in usual units (structgstream inspect shows the similarity)."
            )


@dataclass(frozen=True)
class BakingLoss:
    """How well baked Gaussians show what the stream shows, PSNR in dB over all pixels of the cameras."""

    training: float  # at the training cameras
    held_out: float | None  # at the held-out cameras; None without any


@dataclass(frozen=True)
class WrittenFrame:
    """One written frame."""

    path: Path  # the file that has it, complete when all frames are written
    gaussians: int  # number of its Gaussians
    loss: BakingLoss | None  # of the first frame: what was lost; None for the others


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
        numbers: numbers of the frames; a single one if ``output`` is a file for one frame.
        output: see :func:`open_output`.
        options: what is fitted and left out; None for the defaults.

    Raises errors as :func:`open_output`, and StreamError if a frame is lost, or the options leave no Gaussian.
    """
    options = options or FrameOptions()
    header = reader.header
    cameras = [header.camera(name) for name in header.rig.training]
    with open_output(output, format, fps=header.fps, options=options) as write:
        for number in numbers:
            scene = on_device(reader.scene(number), backend.device)
            baked = bake(scene, cameras, backend, degree=options.baked_degree(format))
            loss = baking_loss(scene, baked, reader, backend) if number == numbers[0] else None
            if options.low_pass and scene.sampling is not None:
                baked = with_low_pass(baked, scene.sampling, options.low_pass)
            plain = selected(baked.in_capture_units(header.similarity), options)
            seconds = reader.packets.at(number).pts_seconds
            yield WrittenFrame(write(number, seconds, plain), len(plain), loss)


def selected(gaussians: BakedGaussians, options: FrameOptions) -> BakedGaussians:
    """The Gaussians inside the box and above the opacity of ``options``, and of these the most important. Raises
    StreamError if none is left."""
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
    rig = reader.header.rig
    training, held_out = ([reader.header.camera(name) for name in names] for names in (rig.training, rig.testing))
    loss = pictures_psnr(scene, baked, training, backend)
    return BakingLoss(loss, pictures_psnr(scene, baked, held_out, backend) if held_out else None)


def pictures_psnr(one: Drawable, other: Drawable, cameras: Sequence[Camera], backend: Backend) -> float:
    """PSNR, dB, of all pixels that ``cameras`` see of two models, in the units of both."""
    errors, pixels = 0.0, 0
    with torch.no_grad():
        for camera in cameras:
            pictures = [render(model, camera, backend).image.clamp(0.0, 1.0) for model in (one, other)]
            errors += float((pictures[0] - pictures[1]).double().square().sum())
            pixels += pictures[0].numel()
    return -10.0 * math.log10(max(errors / pixels, 1e-12))
