# SPDX-License-Identifier: Apache-2.0
"""Hand-overs of a run of groups in a process of its own, so that many borders are handed over side by side.

A hand-over needs the group before it, and of that only frames that no hand-over has changed any more if the group is
long enough. So runs of groups do not need each other, and give the bytes that one process would.

Run as a program: ``python -m structgstream.groups.handing_run DEVICE OUTPUT PREVIOUS SEGMENT...``.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

from structgstream.codec.container.records import PREFIX, read_record
from structgstream.codec.header import unpack_header
from structgstream.codec.packets import StreamHeader
from structgstream.executors.task import PYTHON, Task
from structgstream.groups.hand_over import OWN_FRAMES
from structgstream.groups.handing import Border, Handing
from structgstream.groups.segment_file import open_segment
from structgstream.kernels.backend import BackendName, select_backend
from structgstream.whole_files import write_whole

MOST_GROUPS = 8
"""Of a run: a process takes two seconds to start, and its result is reported when it ends."""


@dataclass(frozen=True)
class HandedRun:
    """What a run has made.

    Args:
        borders: what happened at each, in order.
        records: of the packets of all its groups, in order.
    """

    borders: tuple[Border, ...]
    records: tuple[bytes, ...]

    @classmethod
    def read(cls, path: Path) -> "HandedRun":
        """The run that :func:`main` has written to ``path``."""
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
    """Runs of groups that do not need each other, without the first group, to which nothing is handed over.

    Args:
        lengths: number of frames of each group, in order.
        workers: at least so many runs, where groups are long enough.
    """
    size = min(MOST_GROUPS, -(-(len(lengths) - 1) // workers))
    runs, begin = [], 1
    for number in range(2, len(lengths)):
        if number - begin >= size and lengths[number - 1] >= OWN_FRAMES:
            runs.append(range(begin, number))
            begin = number
    return [*runs, range(begin, len(lengths))] if len(lengths) > 1 else []


def run_task(paths: Sequence[Path], output: Path, *, device: str) -> Task:
    """The task of handing over to the groups ``paths[1:]``, of which ``paths[0]`` is before the first."""
    words = (PYTHON, "-m", "structgstream.groups.handing_run", device, str(output), *map(str, paths))
    return Task(output.name, words, str(output))


def header_of(init: bytes) -> StreamHeader:
    """The header in the bytes of prefix and init record."""
    record = read_record(init, PREFIX.size)
    assert record is not None, "verified when the segment was opened"
    return unpack_header(record.payload)


def _records(handing: Handing, paths: Sequence[Path]) -> Iterator[bytes]:
    for path in paths:
        segment = open_segment(path)
        yield from handing.records(segment)
        segment.close()


def main(arguments: list[str]) -> None:
    """Writes the borders as a line of JSON, and the records after it."""
    device, output, previous, *paths = arguments
    before, borders = open_segment(Path(previous)), list[Border]()
    handing = Handing(header_of(before.init), select_backend(cast(BackendName, device)), on_border=borders.append)
    handing.follow(before)
    before.close()
    records = b"".join(_records(handing, [Path(path) for path in paths]))
    write_whole(Path(output), json.dumps([asdict(border) for border in borders]).encode() + b"\n" + records)


if __name__ == "__main__":
    main(sys.argv[1:])
