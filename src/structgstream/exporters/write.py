# SPDX-License-Identifier: Apache-2.0
"""Writes baked Gaussians in the formats of other programs."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.errors import StreamError
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.exporters.formats import Format
from structgstream.exporters.ply import ply_bytes
from structgstream.exporters.splat import splat_bytes
from structgstream.exporters.spz import spz_bytes

FORMAT_BYTES: Mapping[Format, Callable[[BakedGaussians], bytes]] = {
    "ply": ply_bytes,
    "splat": splat_bytes,
    "spz": spz_bytes,
}


def write_gaussians(path: Path, gaussians: BakedGaussians, *, format: Format) -> int:
    """Writes a file of ``gaussians`` atomically, and creates its folder if necessary.

    An existing file at ``path`` is replaced only when the new one is complete.

    Args:
        path: the file.
        gaussians: the Gaussians, in the file's units, OpenCV axes.
        format: format of the file; ``splat`` supports only degree 0.

    Returns:
        size of the file, bytes.

    Raises:
        ConfigError: the format does not support these Gaussians.
        StreamError: a value is not finite, or a scale is not positive.
        StorageError: the file cannot be written.
    """
    check_finite(gaussians)
    data = FORMAT_BYTES[format](gaussians)
    atomic_write(path, data, new_folder=True)
    return len(data)


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
