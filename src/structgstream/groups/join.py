# SPDX-License-Identifier: Apache-2.0
"""Segments put together to one stream file, with or without a hand-over at their borders."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import accumulate
from pathlib import Path
from typing import BinaryIO

from structgstream.codec.container.index import pack_index
from structgstream.codec.reader import open_stream
from structgstream.errors import ConfigError, StreamError, TaskError
from structgstream.executors.executor import TaskQueue
from structgstream.executors.local import LocalEngine
from structgstream.executors.places import shared_out
from structgstream.groups.handing import Border, Handing
from structgstream.groups.handing_run import HandedRun, header_of, run_task, runs_of
from structgstream.groups.segment_file import Segment, open_segment
from structgstream.kernels.backend import Backend
from structgstream.owned_folders import own_folder, remove_own
from structgstream.training.online.patching import IDS_PER_FRAME
from structgstream.whole_files import whole_file

POLL_SECONDS = 0.2
PURPOSE = "hand-over of a join"
RUNS = re.compile(r"run-\d+(\.partial)?")


def join_segments(
    paths: Sequence[Path],
    output: Path,
    *,
    check: bool = False,
    backend: Backend | None = None,
    workers: int = 1,
    on_border: Callable[[Border], None] | None = None,
) -> int:
    """Writes the stream of these segments, in order of their frames, and returns how many frames it has.

    ``output`` is replaced only by a whole stream. One segment is in memory at a time, and of it one packet; with
    several workers also the packets of some eight groups for each of them. The bytes are the same for any number.
    With a back-end, what stands still at a border is handed over from group to group (``hand_over``), for which packets
    are coded again; otherwise they are copied.

    Args:
        paths: of finished segments, in any order.
        output: the stream file.
        check: decode every frame of the result, and check the births of free Gaussians, before it gets its name.
        backend: the compute back-end of the hand-over, which draws the frames around borders; None for a plain copy.
        workers: processes that hand over, each with one thread; one of this process. A GPU has one.
        on_border: called for each hand-over, in order.

    Raises:
        StreamError: a segment is damaged or not finished, or frames are missing, or there twice.
        ConfigError: the segments have different headers, or are of different captures; or several workers for a GPU.
        StorageError: the stream cannot be written.
        TaskError: a worker failed.
    """
    if workers < 1 or (workers > 1 and backend is not None and backend.name == "cuda"):
        raise ConfigError(f"{workers} workers cannot hand over; there is one on a GPU, and one or more on processors.")
    segments = _in_order(paths)
    ordered = [path for path, _, _ in segments]
    runs = runs_of([frames for _, _, frames in segments], workers=workers)
    # Free Gaussians that stand still outlive their group when a join links them.
    ends = accumulate(frames for _, _, frames in segments)
    firsts = [0, *ends][:-1] if backend is None else [0]
    with whole_file(output, check=(lambda path: check_births(path, firsts)) if check else None) as file:
        written = _Written(file)
        written.add(segments[0][1])
        if backend is not None and workers > 1 and len(runs) > 1:
            written.segment(ordered[0], None)
            with _folder_of_runs(output) as folder:
                for run, handed in zip(runs, _handed(ordered, runs, folder, backend, workers)):
                    written.run(ordered[run.start : run.stop], handed, on_border)
        else:
            handing = None if backend is None else Handing(header_of(segments[0][1]), backend, on_border=on_border)
            for path in ordered:
                written.segment(path, handing)
        file.write(pack_index(written.entries, file.tell()))
    return len(written.entries)


@contextmanager
def _folder_of_runs(output: Path) -> Iterator[Path]:
    """A folder beside ``output`` while runs are handed over; what a killed join has left there is removed."""
    folder = output.with_name(f"{output.name}.runs")
    remove_own(folder, PURPOSE, RUNS)
    own_folder(folder, PURPOSE)
    try:
        yield folder
    finally:
        remove_own(folder, PURPOSE, RUNS, whole=True)


def _handed(
    paths: Sequence[Path], runs: Sequence[range], folder: Path, backend: Backend, workers: int
) -> Iterator[HandedRun]:
    """What comes of each of ``runs``, in order, by so many processes."""
    outputs = [folder / f"run-{number}" for number in range(len(runs))]
    done = set[str]()
    with TaskQueue(LocalEngine(shared_out(workers=workers, cores=workers))) as queue:
        for run, output in zip(runs, outputs):
            queue.submit(run_task(paths[run.start - 1 : run.stop], output, device=backend.name))
        for output in outputs:
            while output.name not in done:
                for ending in queue.wait(POLL_SECONDS):
                    if not ending.done:
                        said = ending.output.strip().splitlines()[-1:] or [f"status {ending.status}"]
                        raise TaskError(f"A worker that hands over failed: {said[0]}. Try again with one worker.")
                    done.add(ending.name)
            yield HandedRun.read(output)
            output.unlink()


class _Written:
    """The stream while it is written."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.entries: list[tuple[int, int, int]] = []

    def add(self, data: bytes) -> None:
        """Appends bytes that are no packet."""
        self._file.write(data)

    def segment(self, path: Path, handing: Handing | None) -> None:
        """Appends the packets of a segment, as they are or as they are handed over."""
        found = open_segment(path)
        own = (found.record(number) for number in range(len(found.entries)))
        for (frame, kind, _), record in zip(found.entries, own if handing is None else handing.records(found)):
            self._record(frame, kind, record)
        found.close()

    def run(self, paths: Sequence[Path], handed: HandedRun, on_border: Callable[[Border], None] | None) -> None:
        """Appends the packets of segments that were handed over together."""
        records = iter(handed.records)
        for path in paths:
            found = open_segment(path)
            for frame, kind, _ in found.entries:
                self._record(frame, kind, next(records))
            found.close()
        if on_border is not None:
            for border in handed.borders:
                on_border(border)

    def _record(self, frame: int, kind: int, record: bytes) -> None:
        self.entries.append((frame, kind, self._file.tell()))
        self._file.write(record)


def _in_order(paths: Sequence[Path]) -> list[tuple[Path, bytes, int]]:
    """The segments' paths, beginnings and numbers of frames, in order of their frames, checked."""
    if not paths:
        raise ConfigError("There is nothing to join; give the segments of one stream.")
    with ExitStack() as stack:
        found: list[tuple[Path, Segment]] = []
        for path in paths:
            segment = open_segment(path)
            stack.callback(segment.close)
            found.append((path, segment))
        found.sort(key=lambda entry: entry[1].identity.first)
        _check(found)
        return [(path, segment.init, len(segment.entries)) for path, segment in found]


def _check(segments: Sequence[tuple[Path, Segment]]) -> None:
    """Check that segments, in order of their frames, are one stream."""
    first_path, first = segments[0]
    expected = 0
    for path, segment in segments:
        identity = segment.identity
        if not segment.complete:
            raise StreamError(
                f"{path} is not finished or damaged: {segment.reason}. Give its reconstruct command again, then join."
            )
        if segment.init != first.init or identity.header != first.identity.header:
            raise ConfigError(f"{path} has another header than {first_path}; join groups of one header.")
        if identity.capture != first.identity.capture:
            raise ConfigError(f"{path} is of another capture than {first_path}; join groups of one capture.")
        if identity.first != expected:
            what = "are missing" if identity.first > expected else "are there twice"
            low, high = sorted((identity.first, expected))
            raise StreamError(f"Frames {low} to {high - 1} {what} before {path}; a stream has every frame once.")
        expected = identity.end


def check_births(path: Path, firsts: Sequence[int]) -> None:
    """Decode a stream of groups, and check that free Gaussians were spawned in their own group.

    A birth's identity is its frame times 2^32 and a number, so births of different groups are different.

    Args:
        path: of the stream.
        firsts: the first frame of each group, ascending.

    Raises:
        StreamError: a frame cannot be decoded, or has a birth of another group or of a later frame.
    """
    with open_stream(path) as reader:
        group = 0
        for info, scene in reader.scenes():
            if info.index in firsts:
                group = info.index
            frames = scene.free.births // IDS_PER_FRAME
            if len(frames) and not group <= int(frames.min()) <= int(frames.max()) <= info.index:
                raise StreamError(
                    f"Frame {info.index} of {path} has free Gaussians born in frames {int(frames.min())} to "
                    f"{int(frames.max())}; its group begins at frame {group}. Fit its group again."
                )
