# SPDX-License-Identifier: Apache-2.0
"""One pass through a capture for several readers, each of which gets the same frames, in order.

Note [Readers]
~~~~~~~~~~~~~~
Live cameras send nothing twice, and decoding a recording twice costs twice. So the source is read once, and a frame is
cached until every reader has asked for the one after it. A frame from before the first one read, or that is cached no
more, is read from the source again, which has those that a resumed run needs.
"""

import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress

from structgstream.data.source import FrameStream, SourceFacts, frame_count, retain_frames
from structgstream.frames import MultiViewFrame


class SharedFrames:
    """A source that is read once (Note [Readers]). Thread-safe.

    Args:
        starts: number of the frame with which each reader begins.
        first: number of the frame that each one needs again when it is resumed, until it states another
            (``RetainsFrames``).

    Attributes:
        readers: a stream for each, in the order of ``starts``.
    """

    def __init__(self, source: FrameStream, *, starts: Sequence[int], first: Sequence[int]) -> None:
        self._source = source
        self._positions, self._next = [*starts], min(starts)
        self._needs = [(one, 0) for one in first]
        self._cached: dict[int, MultiViewFrame] = {}
        self._frames: Iterator[MultiViewFrame] | None = None
        self._reading = self._ended = False
        self._failed: BaseException | None = None
        self._changed = threading.Condition()
        reader = _Reader if frame_count(source) is None else _RecordingReader
        self.readers: tuple[FrameStream, ...] = tuple(reader(self, source, number) for number in range(len(starts)))
        self._retain()

    def take(self, reader: int, index: int) -> MultiViewFrame | None:
        """Frame ``index`` for a reader, which does not need those before; None after the last one.

        An error of the source is raised for every reader.
        """
        with self._changed:
            self._positions[reader] = max(self._positions[reader], index)
            for done in [one for one in self._cached if one < min(self._positions)]:
                del self._cached[done]
            while index >= self._next and not self._ended:
                if self._reading:
                    self._changed.wait()
                else:
                    self._read()
            if index in self._cached:
                return self._cached[index]
            if self._failed is not None:
                raise self._failed
            again = index < self._next
        return self._again(index) if again else None

    def retain(self, reader: int, first: int, *, last: int) -> None:
        """Retains what a reader needs again when it is resumed: see ``RetainsFrames``."""
        with self._changed:
            self._needs[reader] = first, last
        self._retain()

    def close(self) -> None:
        """Closes the source, after the readers."""
        with self._changed:
            frames, self._frames, self._ended = self._frames, None, True
        if frames is not None:
            _close(frames)

    def _read(self) -> None:
        """Reads a frame without the lock, so that others may take cached ones."""
        self._reading = True
        if self._frames is None:
            self._frames = self._source.frames(self._next)
        frames = self._frames
        self._changed.release()
        found, failed = None, None
        try:
            found = next(frames, None)
        except BaseException as error:  # raised in every reader
            failed = error
        finally:
            self._changed.acquire()
            self._reading = False
            self._failed, self._ended = failed, found is None
            if found is not None:
                self._cached[self._next] = found
                self._next += 1
            self._changed.notify_all()

    def _again(self, index: int) -> MultiViewFrame | None:
        """A frame of before."""
        frames = self._source.frames(index)
        try:
            return next(frames, None)
        finally:
            _close(frames)

    def _retain(self) -> None:
        firsts = dict.fromkeys(first for first, _ in self._needs)
        retain_frames(self._source, *firsts, last=max(last for _, last in self._needs))


class _Reader(SourceFacts[FrameStream]):
    """One of several readers of a stream."""

    def __init__(self, shared: SharedFrames, source: FrameStream, number: int) -> None:
        self._shared, self.source, self._number = shared, source, number

    def retain(self, *first: int, last: int) -> None:
        """See ``RetainsFrames``."""
        (one,) = first
        self._shared.retain(self._number, one, last=last)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """The frames from ``start`` on; one that was the last asked for may be asked for again."""
        index = start
        while (frame := self._shared.take(self._number, index)) is not None:
            yield frame
            index += 1


class _RecordingReader(_Reader):
    """One of several readers of a recording."""

    def __len__(self) -> int:
        count = frame_count(self.source)
        assert count is not None, "a recording"
        return count


def _close(frames: Iterator[MultiViewFrame]) -> None:
    with suppress(AttributeError):  # An iterator need not be a generator.
        frames.close()  # type: ignore[attr-defined]
