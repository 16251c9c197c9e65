# SPDX-License-Identifier: Apache-2.0
"""Baked Gaussians of a stream's frames as files that others open."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path

from structgstream.errors import StreamError
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.exporters.formats import Format
from structgstream.exporters.ply import ply_bytes
from structgstream.exporters.splat import splat_bytes
from structgstream.exporters.spz import spz_bytes
from structgstream.whole_files import write_whole

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
        gaussians: in the file's units, OpenCV axes.
        format: of the file; ``splat`` holds degree 0 only.

    Returns:
        Bytes of the file.

    Raises:
        ConfigError: the format cannot hold these Gaussians.
        StreamError: a value is no number that a format can hold.
        StorageError: the file cannot be written.
    """
    check_finite(gaussians)
    data = FORMAT_BYTES[format](gaussians)
    write_whole(path, data, new_folder=True)
    return len(data)


def check_finite(gaussians: BakedGaussians) -> None:
    """Check that every value is finite, and every scale positive, as their logarithms are stored.

    Raises:
        StreamError: naming the values.
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
