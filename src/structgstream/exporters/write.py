# SPDX-License-Identifier: Apache-2.0
"""Baked Gaussians of a stream's frames as files that others open."""

from collections.abc import Callable, Mapping
from pathlib import Path

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
        StorageError: the file cannot be written.
    """
    data = FORMAT_BYTES[format](gaussians)
    write_whole(path, data, new_folder=True)
    return len(data)
