# SPDX-License-Identifier: Apache-2.0
"""Bakes frames of a stream and writes them one by one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from structgstream.codec.reader import StreamReader
from structgstream.exporters.bake import BakingConfig, bake, with_low_pass
from structgstream.exporters.formats import Format
from structgstream.exporters.request import is_one_file
from structgstream.exporters.write import write_gaussians
from structgstream.kernels.backend import Backend
from structgstream.scene.state import on_device


@dataclass(frozen=True)
class WrittenFrame:
    """One written file: its path, its size in bytes, and its number of Gaussians."""

    path: Path
    bytes: int
    gaussians: int


def write_frames(
    reader: StreamReader,
    numbers: Sequence[int],
    output: Path,
    *,
    format: Format,
    backend: Backend,
    degree: int | None = None,
    low_pass: float = 0.0,
) -> Iterator[WrittenFrame]:
    """Bakes frames for the training cameras and writes each in the units of the capture.

    Args:
        reader: the stream.
        numbers: numbers of the frames; a single one if ``output`` is a file.
        output: the file, or a folder for ``frame_000000.ply`` and so on.
        format: format of the files.
        backend: evaluates the MLPs.
        degree: degree of the spherical harmonics; None for the default.
        low_pass: variance by which Gaussians are widened, squared training pixels (``bake.with_low_pass``).

    Raises:
        StreamError: a frame is lost.
        StorageError: a file cannot be written.
    """
    single = is_one_file(output)
    baking = BakingConfig() if degree is None else replace(BakingConfig(), degree=degree)
    header = reader.header
    cameras = [header.camera(name) for name in header.rig.training]
    for number in numbers:
        scene = on_device(reader.scene(number), backend.device)
        plain = bake(scene, cameras, backend, baking=baking)
        if low_pass and scene.sampling is not None:
            plain = with_low_pass(plain, scene.sampling, low_pass)
        path = output if single else output / f"frame_{number:06d}.{format}"
        size_bytes = write_gaussians(path, plain.in_capture_units(header.similarity), format=format)
        yield WrittenFrame(path, size_bytes, len(plain))
