# SPDX-License-Identifier: Apache-2.0
"""Segments put together to one stream file, with or without a hand-over at their borders."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO

from structgstream.codec.container.index import pack_index
from structgstream.codec.container.records import PREFIX, read_record
from structgstream.codec.header import unpack_header
from structgstream.codec.packets import StreamHeader
from structgstream.codec.reader import open_stream
from structgstream.errors import ConfigError, StreamError
from structgstream.groups.handing import Border, Handing
from structgstream.groups.segment_file import Segment, open_segment
from structgstream.kernels.backend import Backend
from structgstream.training.patching import BIRTHS_PER_FRAME
from structgstream.whole_files import whole_file


def join_segments(
    paths: Sequence[Path],
    output: Path,
    *,
    check: bool = False,
    backend: Backend | None = None,
    on_border: Callable[[Border], None] | None = None,
) -> int:
    """Writes the stream of these segments, in order of their frames, and returns how many frames it has.

    ``output`` is replaced only by a whole stream. One segment is in memory at a time, and of it one packet.
    With a back-end, what stands still at a border is handed over from group to group (``hand_over``), for which packets
    are coded again; otherwise they are copied.

    Args:
        paths: of finished segments, in any order.
        output: the stream file.
        check: decode every frame of the result, and check the births of free Gaussians.
        backend: the compute back-end of the hand-over, which draws the frames around borders; None for a plain copy.
        on_border: called for each hand-over, in order.

    Raises:
        StreamError: a segment is damaged or not finished, or frames are missing, or there twice.
        ConfigError: the segments have different headers, or are of different captures.
        StorageError: the stream cannot be written.
    """
    segments = _in_order(paths)
    with whole_file(output) as file:
        written = _Written(file)
        written.add(segments[0][1])
        handing = None if backend is None else Handing(_header(segments[0][1]), backend, on_border=on_border)
        for path, _, _ in segments:
            written.segment(path, handing)
        file.write(pack_index(written.entries, file.tell()))
    if check:
        # Free Gaussians that stand still outlive their group when they are handed over.
        check_births(output, [first for _, _, first in segments] if backend is None else [0])
    return len(written.entries)


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
            self.entries.append((frame, kind, self._file.tell()))
            self._file.write(record)
        found.close()


def _header(init: bytes) -> StreamHeader:
    """The header in the bytes of prefix and init record."""
    record = read_record(init, PREFIX.size)
    assert record is not None, "verified when the segment was opened"
    return unpack_header(record.payload)


def _in_order(paths: Sequence[Path]) -> list[tuple[Path, bytes, int]]:
    """The segments' paths, beginnings and first frames, in order of their frames, checked."""
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
        return [(path, segment.init, segment.identity.first) for path, segment in found]


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
    """Decode a stream of groups, and check that free Gaussians were born in their own group.

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
            frames = scene.free.births // BIRTHS_PER_FRAME
            if len(frames) and not group <= int(frames.min()) <= int(frames.max()) <= info.index:
                raise StreamError(
                    f"Frame {info.index} of {path} has free Gaussians born in frames {int(frames.min())} to "
                    f"{int(frames.max())}; its group begins at frame {group}. Fit its group again."
                )
