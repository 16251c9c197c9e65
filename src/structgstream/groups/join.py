# SPDX-License-Identifier: Apache-2.0
"""Joins segments to one stream file, with or without a seam blend at their borders.

A seam blend needs the last two frames of the group before. If that group is long enough, its own blend has faded by
then. So a run of groups that starts after such a group is independent of other runs: processes blend runs side by side
(this module as a program: ``DEVICE OUTPUT PREVIOUS SEGMENT...``), and give the same bytes as a single process.
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import accumulate
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

from structgstream.atomic_files import atomic_file, atomic_write
from structgstream.codec.container.records import FRAME, pack_index
from structgstream.codec.reader import open_stream
from structgstream.errors import ConfigError, StreamError, TaskError
from structgstream.executors.tasks import PYTHON, LocalEngine, Task, TaskQueue, allocate_slots
from structgstream.groups.seam_blend import OWN_FRAMES, Border, GroupBlender
from structgstream.groups.segment_file import Segment, open_segment, verified_record
from structgstream.kernels.backend import Backend, BackendName, select_backend
from structgstream.training.online.patching import IDS_PER_FRAME

MAX_GROUPS = 8
"""Number of groups after which a run ends, or more if the last of them has fewer than :data:`OWN_FRAMES` frames: a
process takes two seconds to start, and reports its result only when it ends."""
POLL_SECONDS = 0.2
OnBorder = Callable[[Border], object]


def join_segments(
    paths: Sequence[Path],
    output: Path,
    *,
    check: bool = False,
    backend: Backend | None = None,
    workers: int = 1,
    on_border: OnBorder = lambda border: None,
) -> int:
    """Writes the stream of these segments, in order of their frames, and returns its number of frames.

    ``output`` is replaced only by a complete stream. Memory: one group; with several workers also the packets of about
    eight groups per worker. The bytes do not depend on the number of workers. With a back-end, static content is
    blended at borders (``seam_blend``) and packets are coded again; otherwise packets are copied.

    Args:
        check: decode every frame of the result and check the identities of free Gaussians before it is renamed.
        backend: the compute back-end that renders the frames around borders; None to copy packets.
        workers: processes that blend borders, each with one thread; 1 for this process. A GPU needs 1.

    Raises:
        StreamError: a segment is damaged or not finished, or frames are missing or duplicated.
        ConfigError: segments have different headers or captures, or there are several workers for a GPU.
        StorageError: the stream cannot be written.
        TaskError: a worker failed.
    """
    if workers < 1 or (workers > 1 and backend is not None and backend.name == "cuda"):
        raise ConfigError(f"{workers} workers cannot blend borders; use one on a GPU, and one or more on CPUs.")
    first, ordered, lengths = _in_order(paths)
    # A blended stream is checked as a single group.
    firsts = [0, *accumulate(lengths)][:-1] if backend is None else [0]
    runs = [] if backend is None or workers == 1 else runs_of(lengths, workers=workers)
    if backend is not None and len(runs) > 1:
        records = _blended_by_workers(ordered, runs, output, backend, workers, on_border)
    else:
        blender = None if backend is None else GroupBlender(first.header, backend, on_border=on_border)
        records = _records(ordered, blender)
    entries: list[tuple[int, int, int]] = []
    with atomic_file(output, check=(lambda path: check_births(path, firsts)) if check else None) as file:
        file.write(first.init)
        for data in records:
            record = verified_record(data)
            entries.append((FRAME.unpack_from(record.payload)[0], record.type, file.tell()))
            file.write(data)
        file.write(pack_index(entries, file.tell()))
    return len(entries)


def _records(paths: Sequence[Path], blender: GroupBlender | None) -> Iterator[bytes]:
    """The records of the packets of all segments, copied or blended."""
    for path in paths:
        segment = open_segment(path)
        yield from segment.records() if blender is None else blender.records(segment)


def runs_of(lengths: Sequence[int], *, workers: int) -> list[range]:
    """Independent runs of groups, without the first group, which is not blended; at least one for each of ``workers``
    processes if groups are long enough."""
    size = min(MAX_GROUPS, -(-(len(lengths) - 1) // workers))
    runs, begin = [], 1
    for number in range(2, len(lengths)):
        if number - begin >= size and lengths[number - 1] >= OWN_FRAMES:
            runs.append(range(begin, number))
            begin = number
    return [*runs, range(begin, len(lengths))] if len(lengths) > 1 else []


def _blended_by_workers(
    paths: Sequence[Path], runs: Sequence[range], output: Path, backend: Backend, workers: int, on_border: OnBorder
) -> Iterator[bytes]:
    """The records of all groups in order; ``workers`` processes blend the runs, into files beside ``output``."""
    yield from _records(paths[:1], None)
    done = set[str]()
    slots = allocate_slots(workers=workers, cores=workers)
    beside = TemporaryDirectory(prefix=f".{output.name}.runs-", dir=output.parent)
    with beside as folder, TaskQueue(LocalEngine(slots)) as q:
        outputs = [Path(folder, f"run-{number}") for number in range(len(runs))]
        for run, result in zip(runs, outputs):
            q.submit(run_task(paths[run.start - 1 : run.stop], result, device=backend.name))
        for result in outputs:
            while result.name not in done:
                for ended in q.wait(POLL_SECONDS):
                    if not ended.done:
                        last_line = ended.output.strip().splitlines()[-1:] or [f"status {ended.status}"]
                        raise TaskError(
                            f"A worker that blends borders failed: {last_line[0]}. Try again with one worker."
                        )
                    done.add(ended.name)
            borders, records = read_run(result)
            for border in borders:
                on_border(border)
            yield from records
            result.unlink()


def run_task(paths: Sequence[Path], output: Path, *, device: str) -> Task:
    """The task of blending the groups ``paths[1:]``, which follow the group ``paths[0]``."""
    argv = (PYTHON, "-m", "structgstream.groups.join", device, str(output), *map(str, paths))
    return Task(output.name, argv, str(output))


def main(arguments: list[str]) -> None:
    """Blends a run; writes its borders as a line of JSON, followed by the records of its packets."""
    device, output, previous, *paths = arguments
    before, borders = open_segment(Path(previous)), list[Border]()
    blender = GroupBlender(before.header, select_backend(cast(BackendName, device)), on_border=borders.append)
    blender.follow(before)
    records = b"".join(_records([Path(path) for path in paths], blender))
    atomic_write(Path(output), json.dumps([asdict(border) for border in borders]).encode() + b"\n" + records)


def read_run(path: Path) -> tuple[list[Border], list[bytes]]:
    """The borders and the records that :func:`main` has written to ``path``."""
    data, records = path.read_bytes(), list[bytes]()
    at = data.index(b"\n") + 1
    borders = [Border(**border) for border in json.loads(data[:at])]
    while at < len(data):
        end = verified_record(data, at).end
        records.append(data[at:end])
        at = end
    return borders, records


def _in_order(paths: Sequence[Path]) -> tuple[Segment, list[Path], list[int]]:
    """The first segment, and paths and numbers of frames of all in order, which form one stream."""
    if not paths:
        raise ConfigError("There is nothing to join; give the segments of one stream.")
    found = [(path, replace(open_segment(path), data=b"")) for path in paths]
    found.sort(key=lambda entry: entry[1].identity.first)
    (first_path, first), expected = found[0], 0
    for path, segment in found:
        identity = segment.identity
        if not segment.complete:
            raise StreamError(
                f"{path} is not finished or damaged: {segment.reason}. Run its fit-group command again, then join."
            )
        if segment.init != first.init or identity.header != first.identity.header:
            raise ConfigError(f"{path} has another header than {first_path}; join groups of one header.")
        if identity.capture != first.identity.capture:
            raise ConfigError(f"{path} is of another capture than {first_path}; join groups of one capture.")
        if identity.first != expected:
            what = "are missing" if identity.first > expected else "are duplicated"
            low, high = sorted((identity.first, expected))
            raise StreamError(f"Frames {low} to {high - 1} {what} before {path}; a stream needs every frame once.")
        expected = identity.end
    return first, [path for path, _ in found], [len(segment.entries) for _, segment in found]


def check_births(path: Path, firsts: Sequence[int]) -> None:
    """Decode a stream of groups, which begin at frames ``firsts``, and check that free Gaussians were spawned in their
    own group.

    The identity of a spawned Gaussian is its frame times 2^32 plus a number, so identities of groups do not collide.
    Raises StreamError if a frame cannot be decoded, or has a Gaussian that was spawned in another group or a later
    frame.
    """
    with open_stream(path) as reader:
        group = 0
        for info, scene in reader.scenes():
            if info.index in firsts:
                group = info.index
            frames = scene.free.births // IDS_PER_FRAME
            if len(frames) and not group <= int(frames.min()) <= int(frames.max()) <= info.index:
                raise StreamError(
                    f"Frame {info.index} of {path} has free Gaussians spawned in frames {int(frames.min())} to "
                    f"{int(frames.max())}; its group begins at frame {group}. Fit its group again."
                )


if __name__ == "__main__":
    main(sys.argv[1:])
