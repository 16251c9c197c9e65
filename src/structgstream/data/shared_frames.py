# SPDX-License-Identifier: Apache-2.0
"""One reading of a capture for several readers, each of which gets the same frames, in order.

Note [Readers]
~~~~~~~~~~~~~~
What a live camera has sent nobody gets twice, and decoding a recording twice costs twice. So there is one reading, and
a frame is held until every reader has asked for the one after it: as many are held as readers are apart, and one for
each that reads ahead. A frame from before the reading began, or that nobody holds any more, is read from the source
again, which has those that a resumed run needs.
"""

import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress

from structgstream.data.source import FrameStream, frame_count, keep_frames, may_read_ahead
from structgstream.data.wrappers import SourceFacts
from structgstream.frames import MultiViewFrame


class SharedFrames:
    """A source that is read once (Note [Readers]). Thread-safe.

    Args:
        source: the capture, or live cameras.
        starts: number of the frame with which each reader begins.
        first: number of the frame that each one needs again when it is resumed, until it says otherwise
            (``KeepsFrames``).

    Attributes:
        readers: a stream for each, in the order of ``starts``.
    """

    def __init__(self, source: FrameStream, *, starts: Sequence[int], first: Sequence[int]) -> None:
        self._source = source
        self._positions, self._next = [*starts], min(starts)
        self._needs = [(one, 0) for one in first]
        self._held: dict[int, MultiViewFrame] = {}
        self._frames: Iterator[MultiViewFrame] | None = None
        self._reading = self._ended = False
        self._failed: BaseException | None = None
        self._changed = threading.Condition()
        reader = _Reader if frame_count(source) is None else _RecordingReader
        self.readers: tuple[FrameStream, ...] = tuple(reader(self, source, number) for number in range(len(starts)))
        self._keep()

    def take(self, reader: int, index: int) -> MultiViewFrame | None:
        """Frame ``index`` for a reader, which is done with those before; None after the last one.

        Raises:
            CaptureError: the source's; every reader gets it.
        """
        with self._changed:
            self._positions[reader] = max(self._positions[reader], index)
            for done in [one for one in self._held if one < min(self._positions)]:
                del self._held[done]
            while index >= self._next and not self._ended:
                if self._reading:
                    self._changed.wait()
                else:
                    self._read()
            if index in self._held:
                return self._held[index]
            if self._failed is not None:
                raise self._failed
            again = index < self._next
        return self._again(index) if again else None

    def keep(self, reader: int, first: int, *, last: int) -> None:
        """What a reader needs again when it is resumed: see ``KeepsFrames``."""
        with self._changed:
            self._needs[reader] = first, last
        self._keep()

    def close(self) -> None:
        """Ends the reading; every reader has been closed before."""
        with self._changed:
            frames, self._frames, self._ended = self._frames, None, True
        if frames is not None:
            _close(frames)

    def _read(self) -> None:
        """Reads a frame; others may take what is held meanwhile."""
        self._reading = True
        if self._frames is None:
            self._frames = self._source.frames(self._next)
        frames = self._frames
        self._changed.release()
        found, failed = None, None
        try:
            found = next(frames, None)
        except BaseException as error:  # told to every reader, whichever asked
            failed = error
        finally:
            self._changed.acquire()
            self._reading = False
            self._failed, self._ended = failed, found is None
            if found is not None:
                self._held[self._next] = found
                self._next += 1
            self._changed.notify_all()

    def _again(self, index: int) -> MultiViewFrame | None:
        """A frame of before."""
        frames = self._source.frames(index)
        try:
            return next(frames, None)
        finally:
            _close(frames)

    def _keep(self) -> None:
        firsts = dict.fromkeys(first for first, _ in self._needs)
        keep_frames(self._source, *firsts, last=max(last for _, last in self._needs))


class _Reader(SourceFacts[FrameStream]):
    """One of several readers of a stream."""

    def __init__(self, shared: SharedFrames, source: FrameStream, number: int) -> None:
        self._shared, self.source, self._number = shared, source, number

    @property
    def newest_only(self) -> bool:
        """See ``ArrivingFrames``."""
        return not may_read_ahead(self.source)

    def keep(self, *first: int, last: int) -> None:
        """See ``KeepsFrames``."""
        (one,) = first
        self._shared.keep(self._number, one, last=last)

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
