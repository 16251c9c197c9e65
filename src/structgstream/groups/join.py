# SPDX-License-Identifier: Apache-2.0
"""Joins segments to one stream file, with or without a seam blend at their borders."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import accumulate
from pathlib import Path
from typing import BinaryIO

from structgstream.atomic_files import atomic_file
from structgstream.codec.container.records import pack_index
from structgstream.codec.reader import open_stream
from structgstream.errors import ConfigError, StreamError, TaskError
from structgstream.executors.tasks import LocalEngine, TaskQueue, allocate_slots
from structgstream.groups.blending_run import BlendedRun, header_of, run_task, runs_of
from structgstream.groups.seam_blend import Border, GroupBlender
from structgstream.groups.segment_file import Segment, open_segment
from structgstream.kernels.backend import Backend
from structgstream.owned_folders import own_folder, remove_own
from structgstream.training.online.patching import IDS_PER_FRAME

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
    """Writes the stream of these segments, in order of their frames, and returns its number of frames.

    ``output`` is replaced only by a complete stream. Memory: one packet; with several workers also the packets of
    about eight groups per worker. The bytes do not depend on the number of workers. With a back-end, static content is
    blended at borders (``seam_blend``) and packets are coded again; otherwise packets are copied.

    Args:
        paths: finished segments, in any order.
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
    segments = _in_order(paths)
    ordered = [path for path, _, _ in segments]
    runs = runs_of([frames for _, _, frames in segments], workers=workers)
    # A blended stream is checked as a single group.
    ends = accumulate(frames for _, _, frames in segments)
    firsts = [0, *ends][:-1] if backend is None else [0]
    with atomic_file(output, check=(lambda path: check_births(path, firsts)) if check else None) as file:
        written = _Written(file)
        written.add(segments[0][1])
        if backend is not None and workers > 1 and len(runs) > 1:
            written.segment(ordered[0], None)
            with _folder_of_runs(output) as folder:
                for run, blended in zip(runs, _blended(ordered, runs, folder, backend, workers)):
                    written.run(ordered[run.start : run.stop], blended, on_border)
        else:
            blender = None if backend is None else GroupBlender(header_of(segments[0][1]), backend, on_border=on_border)
            for path in ordered:
                written.segment(path, blender)
        file.write(pack_index(written.entries, file.tell()))
    return len(written.entries)


@contextmanager
def _folder_of_runs(output: Path) -> Iterator[Path]:
    """A temporary folder next to ``output`` for the results of runs; the remains of a killed join are removed."""
    folder = output.with_name(f"{output.name}.runs")
    remove_own(folder, PURPOSE, RUNS)
    own_folder(folder, PURPOSE)
    try:
        yield folder
    finally:
        remove_own(folder, PURPOSE, RUNS, whole=True)


def _blended(
    paths: Sequence[Path], runs: Sequence[range], folder: Path, backend: Backend, workers: int
) -> Iterator[BlendedRun]:
    """The result of each of ``runs``, in order, computed by ``workers`` processes."""
    outputs = [folder / f"run-{number}" for number in range(len(runs))]
    done = set[str]()
    with TaskQueue(LocalEngine(allocate_slots(workers=workers, cores=workers))) as queue:
        for run, output in zip(runs, outputs):
            queue.submit(run_task(paths[run.start - 1 : run.stop], output, device=backend.name))
        for output in outputs:
            while output.name not in done:
                for result in queue.wait(POLL_SECONDS):
                    if not result.done:
                        last_line = result.output.strip().splitlines()[-1:] or [f"status {result.status}"]
                        raise TaskError(
                            f"A worker that blends borders failed: {last_line[0]}. Try again with one worker."
                        )
                    done.add(result.name)
            yield BlendedRun.read(output)
            output.unlink()


class _Written:
    """The stream while it is written."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.entries: list[tuple[int, int, int]] = []

    def add(self, data: bytes) -> None:
        """Appends bytes other than packets."""
        self._file.write(data)

    def segment(self, path: Path, blender: GroupBlender | None) -> None:
        """Appends the packets of a segment, copied or blended."""
        found = open_segment(path)
        own = (found.record(number) for number in range(len(found.entries)))
        for (frame, kind, _), record in zip(found.entries, own if blender is None else blender.records(found)):
            self._record(frame, kind, record)
        found.close()

    def run(self, paths: Sequence[Path], blended: BlendedRun, on_border: Callable[[Border], None] | None) -> None:
        """Appends the packets of segments that one run has blended."""
        records = iter(blended.records)
        for path in paths:
            found = open_segment(path)
            for frame, kind, _ in found.entries:
                self._record(frame, kind, next(records))
            found.close()
        if on_border is not None:
            for border in blended.borders:
                on_border(border)

    def _record(self, frame: int, kind: int, record: bytes) -> None:
        self.entries.append((frame, kind, self._file.tell()))
        self._file.write(record)


def _in_order(paths: Sequence[Path]) -> list[tuple[Path, bytes, int]]:
    """Path, prefix with init record, and number of frames of each segment, checked and in order of frames."""
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
    """Check that segments, in order of their frames, form one stream."""
    first_path, first = segments[0]
    expected = 0
    for path, segment in segments:
        identity = segment.identity
        if not segment.complete:
            raise StreamError(
                f"{path} is not finished or damaged: {segment.reason}. Run its reconstruct command again, then join."
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


def check_births(path: Path, firsts: Sequence[int]) -> None:
    """Decode a stream of groups, and check that free Gaussians were spawned in their own group.

    The identity of a spawned Gaussian is its frame times 2^32 plus a number, so identities of groups do not collide.

    Args:
        firsts: the first frame of each group, ascending.

    Raises:
        StreamError: a frame cannot be decoded, or has a Gaussian that was spawned in another group or a later frame.
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
