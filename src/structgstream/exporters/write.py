# SPDX-License-Identifier: Apache-2.0
"""Writes baked Gaussians in the formats of other programs: to a file, a folder, a zip, or a file of all frames."""

import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Protocol

from structgstream.atomic_files import atomic_file, atomic_write, give_name
from structgstream.errors import StorageError, StreamError
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.exporters.formats import FORMATS, Format, FrameOptions
from structgstream.exporters.fourdgs import FourDgsFile
from structgstream.exporters.glb import glb_bytes
from structgstream.exporters.ply import ply_bytes
from structgstream.exporters.request import is_one_file
from structgstream.exporters.sog import sog_bytes
from structgstream.exporters.splat import splat_bytes
from structgstream.exporters.spz import spz_bytes
from structgstream.exporters.usd import UsdFile

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

    def add(self, number: int, gaussians: BakedGaussians) -> None: ...

    def save(self, path: Path) -> None: ...


FRAMES_FILES: Mapping[Format, Callable[..., FramesFile]] = {"usd": UsdFile, "4dgs": FourDgsFile}
"""Formats with one file for all frames."""
FrameWriter = Callable[[int, BakedGaussians], Path]
"""Writes a frame, given its number, and returns the file that has it when the output is complete."""


@contextmanager
def open_output(output: Path, format: Format, *, fps: float, options: FrameOptions) -> Iterator[FrameWriter]:
    """What writes frames to ``output``, which is complete at the end of the block.

    Args:
        output: a file for one frame; ``NAME.zip``; a file of all frames; or a folder for ``frame_000000.ply`` etc.
        format: format of the files.
        fps: frames per second of the stream.
        options: options of the format.

    Raises:
        ConfigError: the format does not support these Gaussians.
        StreamError: a value is not finite, or a scale is not positive.
        StorageError: a file cannot be written; an existing file is not affected.
        MissingExtraError: a package is not installed.
    """
    folder = output.is_dir()
    if FORMATS[format].all_frames:
        collected = FRAMES_FILES[format](fps=fps)
        if folder:
            output = output / f"frames.{format}"

        def collect(number: int, gaussians: BakedGaussians) -> Path:
            check_finite(gaussians)
            collected.add(number, gaussians)
            return output

        yield collect
        _save(collected, output)
    elif output.suffix.lower() == ".zip" and not folder:
        output.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(output) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            yield lambda number, gaussians: _into_zip(archive, output, number, gaussians, format, options)
    else:
        single = is_one_file(output)
        yield lambda number, gaussians: write_gaussians(
            output if single else output / frame_name(number, format), gaussians, format=format, options=options
        )


def frame_name(number: int, format: Format) -> str:
    """Name of a frame's file: one prefix, so that editors see a sequence."""
    return f"frame_{number:06d}.{format}"


def write_gaussians(
    path: Path, gaussians: BakedGaussians, *, format: Format, options: FrameOptions | None = None
) -> Path:
    """Writes a file of ``gaussians`` atomically, and creates its folder if necessary.

    An existing file at ``path`` is replaced only when the new one is complete.

    Args:
        path: the file.
        gaussians: the Gaussians, in the file's units, OpenCV axes.
        format: format of the file; ``splat`` supports only degree 0.
        options: options of the format; None for the defaults.

    Returns:
        ``path``.

    Raises:
        ConfigError: the format does not support these Gaussians.
        StreamError: a value is not finite, or a scale is not positive.
        StorageError: the file cannot be written.
        MissingExtraError: a package is not installed.
    """
    check_finite(gaussians)
    atomic_write(path, FORMAT_BYTES[format](gaussians, options or FrameOptions()), new_folder=True)
    return path


def _into_zip(
    archive: zipfile.ZipFile,
    output: Path,
    number: int,
    gaussians: BakedGaussians,
    format: Format,
    options: FrameOptions,
) -> Path:
    check_finite(gaussians)
    entry = zipfile.ZipInfo(frame_name(number, format))  # with a fixed date
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, FORMAT_BYTES[format](gaussians, options))
    return output


def _save(collected: FramesFile, output: Path) -> None:
    partial = output.with_name(f"{output.stem}.partial{output.suffix}")  # libraries go by the suffix
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        collected.save(partial)
        give_name(partial, output)
    except Exception as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise StorageError(f"{output} cannot be written ({error.strerror or error}).") from error
        raise


def check_finite(gaussians: BakedGaussians) -> None:
    """Check that every value is finite and every scale is positive, because logarithms of scales are stored.

    Raises:
        StreamError: they are not; the message names the values.
    """
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
