# SPDX-License-Identifier: Apache-2.0
"""Seam blends of a run of consecutive groups in a process of its own, so that runs are blended in parallel.

A seam blend needs the last two frames of the group before. If that group is long enough, its own blend has faded by
then. A run that starts after such a group is independent of other runs, and gives the same bytes as a single process.

Run as a program: ``python -m structgstream.groups.blending_run DEVICE OUTPUT PREVIOUS SEGMENT...``.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

from structgstream.atomic_files import atomic_write
from structgstream.codec.container.records import PREFIX, read_record
from structgstream.codec.header import unpack_header
from structgstream.codec.packets import StreamHeader
from structgstream.executors.tasks import PYTHON, Task
from structgstream.groups.seam_blend import OWN_FRAMES, Border, GroupBlender
from structgstream.groups.segment_file import open_segment
from structgstream.kernels.backend import BackendName, select_backend

MAX_GROUPS = 8
"""Largest number of groups in a run: a process takes two seconds to start, and reports its result when it ends."""


@dataclass(frozen=True)
class BlendedRun:
    """Result of a run."""

    borders: tuple[Border, ...]  # result at each border, in order
    records: tuple[bytes, ...]  # records of the packets of all its groups, in order

    @classmethod
    def read(cls, path: Path) -> "BlendedRun":
        """Reads the run that :func:`main` has written to ``path``."""
        data = path.read_bytes()
        at = data.index(b"\n") + 1
        borders, records = tuple(Border(**border) for border in json.loads(data[:at])), list[bytes]()
        while at < len(data):
            record = read_record(data, at)
            assert record is not None, "the file was written whole"
            records.append(data[at : record.end])
            at = record.end
        return cls(borders, tuple(records))


def runs_of(lengths: Sequence[int], *, workers: int) -> list[range]:
    """Independent runs of groups, without the first group, which is not blended.

    Args:
        lengths: number of frames of each group, in order.
        workers: number of processes; there are at least as many runs if groups are long enough.
    """
    size = min(MAX_GROUPS, -(-(len(lengths) - 1) // workers))
    runs, begin = [], 1
    for number in range(2, len(lengths)):
        if number - begin >= size and lengths[number - 1] >= OWN_FRAMES:
            runs.append(range(begin, number))
            begin = number
    return [*runs, range(begin, len(lengths))] if len(lengths) > 1 else []


def run_task(paths: Sequence[Path], output: Path, *, device: str) -> Task:
    """The task of blending the groups ``paths[1:]``, which follow the group ``paths[0]``."""
    argv = (PYTHON, "-m", "structgstream.groups.blending_run", device, str(output), *map(str, paths))
    return Task(output.name, argv, str(output))


def header_of(init: bytes) -> StreamHeader:
    """The header in the bytes of prefix and init record."""
    record = read_record(init, PREFIX.size)
    assert record is not None, "verified when the segment was opened"
    return unpack_header(record.payload)


def _records(blender: GroupBlender, paths: Sequence[Path]) -> Iterator[bytes]:
    for path in paths:
        segment = open_segment(path)
        yield from blender.records(segment)
        segment.close()


def main(arguments: list[str]) -> None:
    """Writes the borders as a line of JSON, followed by the records."""
    device, output, previous, *paths = arguments
    before, borders = open_segment(Path(previous)), list[Border]()
    blender = GroupBlender(header_of(before.init), select_backend(cast(BackendName, device)), on_border=borders.append)
    blender.follow(before)
    before.close()
    records = b"".join(_records(blender, [Path(path) for path in paths]))
    atomic_write(Path(output), json.dumps([asdict(border) for border in borders]).encode() + b"\n" + records)


if __name__ == "__main__":
    main(sys.argv[1:])
