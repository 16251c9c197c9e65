# SPDX-License-Identifier: Apache-2.0
"""Captures: the protocols of recordings and of streams that are still being filmed, and wrappers of them: resized,
shortened, decoded ahead, with other cameras held out, read once for several readers.

Note [Readers]
~~~~~~~~~~~~~~
Live cameras send nothing twice, and decoding a recording twice costs twice. So the source is read once, and a frame is
cached until every reader has asked for the one after it. A frame from before the first one read, or that is cached no
more, is read from the source again, which has those that a resumed run needs.
"""

import threading
from collections.abc import Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from typing import Generic, Protocol, TypeGuard, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.images import ImageSource, opencv, reduced_mask
from structgstream.data.video import VideoSource
from structgstream.errors import CaptureError, ConfigError
from structgstream.frames import MultiViewFrame
from structgstream.lookahead import Lookahead


class FrameStream(Protocol):
    """A calibrated rig and its frames, in order; how many there will be may be unknown.

    ``frames(start)`` may be called again, each time from the given stream index; it opens its own decoders, and the
    pictures it yields have the size the rig states. Cameras without a picture of an instant are absent from its frame,
    whatever the frame that reading starts from. Problems are raised as ``CaptureError``.
    """

    @property
    def rig(self) -> CameraRig: ...

    @property
    def fps(self) -> float: ...

    @property
    def name(self) -> str: ...

    @property
    def points(self) -> NDArray[np.float64] | None:
        """Points ``[P, 3]`` that come with the capture (a COLMAP model), in its units; None without any."""
        ...

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]: ...


class FrameSource(FrameStream, Protocol):
    """A recording: a stream of frames whose number is known."""

    def __len__(self) -> int:
        """Number of frames, from the one in which the last camera begins (``timeline.common_slots``)."""
        ...


@runtime_checkable
class RetainsFrames(Protocol):
    """A live stream that stores earlier frames, so that a resumed run can read them again."""

    def retain(self, *first: int, last: int) -> None:
        """Retains the frames ``first``, and at any time the ``last`` frames delivered; others may be removed."""
        ...


def retain_frames(source: FrameStream, *first: int, last: int) -> None:
    """Retains the frames that a resumed run reads again; recordings have all of them."""
    if isinstance(source, RetainsFrames):
        source.retain(*first, last=last)


def is_recording(source: FrameStream) -> TypeGuard[FrameSource]:
    """Whether the number of frames is known. Other streams drop stale frames, and must not be prefetched."""
    return isinstance(source, Sized)


def frame_count(source: FrameStream) -> int | None:
    """Number of frames; None if it is unknown before the end."""
    return len(source) if is_recording(source) else None


@contextmanager
def closed(frames: Iterator[MultiViewFrame]) -> Iterator[Iterator[MultiViewFrame]]:
    """``frames``, which may hold a thread or a decoder, closed at the end."""
    try:
        yield frames
    finally:
        if hasattr(frames, "close"):  # An iterator need not be a generator.
            frames.close()  # type: ignore[attr-defined]


Source = TypeVar("Source", bound=FrameStream)


class SourceFacts(Generic[Source]):
    """Attributes that a wrapper takes from its ``source``."""

    source: Source

    @property
    def rig(self) -> CameraRig:
        return self.source.rig

    @property
    def fps(self) -> float:
        return self.source.fps

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def points(self) -> NDArray[np.float64] | None:
        return self.source.points


@dataclass(frozen=True)
class SourceWrapper(SourceFacts[FrameSource]):
    """A recording that passes everything through; base class of the wrappers."""

    source: FrameSource

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        return self.source.frames(start)

    def frames_after(self) -> Iterator[MultiViewFrame]:
        """What follows the last frame of a section, numbered otherwise; nothing if this wrapper changes frames."""
        unchanged = type(self).frames is SourceWrapper.frames
        return self.source.frames_after() if unchanged and isinstance(self.source, SourceWrapper) else iter(())


@dataclass(frozen=True)
class WithRig(SourceWrapper):
    """The same frames under another rig of the same cameras: another held-out set, another near plane."""

    other: CameraRig

    @property
    def rig(self) -> CameraRig:
        return self.other


@dataclass(frozen=True)
class WithoutPoints(SourceWrapper):
    """The same frames, whose initial points are estimated from training cameras when they are needed."""

    @property
    def points(self) -> NDArray[np.float64] | None:
        return None

    def resized(self, rig: CameraRig) -> FrameSource:
        """See ``Resizable``."""
        return replace(self, source=resized_to(self.source, rig))


@dataclass(frozen=True)
class Resized(WithRig):
    """Every picture resampled by area to the size that ``other`` states."""

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        cv2 = opencv()
        sizes = {name: (self.rig[name].width, self.rig[name].height) for name in self.rig}
        for frame in self.source.frames(start):
            own = frame.images.items()
            images = {name: cv2.resize(image, sizes[name], interpolation=cv2.INTER_AREA) for name, image in own}
            masks = {name: reduced_mask(mask, sizes[name]) for name, mask in frame.masks.items()}
            yield replace(frame, images=images, masks=masks)


def unwrapped(source: FrameSource) -> FrameSource:
    """The capture below those wrappers that pass on each of its frames."""
    while isinstance(source, SourceWrapper) and len(source) == len(source.source):
        source = source.source
    return source


def innermost(source: FrameSource) -> FrameSource:
    """The capture below all wrappers."""
    while isinstance(source, SourceWrapper):
        source = source.source
    return source


def apart_seconds(source: FrameSource) -> Mapping[str, NDArray[np.float64]]:
    """Camera name to how long after its instant its picture of each frame was taken, ``[N]`` by its own time stamps;
    NaN where it has none; empty where that is not known, as for pictures without times."""
    return getattr(unwrapped(source), "apart_seconds", {})


@runtime_checkable
class Resizable(Protocol):
    """A source that resamples its pictures anyway and can do so to another size, without resampling twice."""

    def resized(self, rig: CameraRig) -> FrameSource:
        """The same frames at the sizes of ``rig``."""
        ...


@dataclass(frozen=True)
class Section(SourceWrapper):
    """The frames ``first`` to ``first + length - 1`` of a capture, counted and timed from 0 again."""

    first: int
    length: int

    def __len__(self) -> int:
        return self.length

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for frame in islice(self.source.frames(self.first + start), max(self.length - start, 0)):
            index = frame.index - self.first
            yield replace(frame, index=index, pts_seconds=index / self.fps)

    def frames_after(self) -> Iterator[MultiViewFrame]:
        end = self.first + self.length
        if end < len(self.source):
            yield from self.source.frames(end)
        if isinstance(self.source, SourceWrapper):
            yield from self.source.frames_after()


def resized(source: FrameSource, scale: float) -> FrameSource:
    """The capture with pictures of ``scale`` times the size, rounded to pixels; intrinsics follow exactly."""
    if not 0 < scale <= 1:
        raise ConfigError(f"The scale of a capture must lie in (0, 1], got {scale:g}.")
    if scale == 1:
        return source
    rig = source.rig.mapped({name: camera.scaled(scale) for name, camera in source.rig.cameras.items()})
    return resized_to(source, rig)


def resized_to(source: FrameSource, rig: CameraRig) -> FrameSource:
    """The capture with pictures of the sizes of ``rig``, which has the same cameras."""
    return source.resized(rig) if isinstance(source, Resizable) else Resized(source, rig)


def section(source: FrameSource, *, start: int = 0, frames: int | None = None, every: int = 1) -> FrameSource:
    """``frames`` frames (None: all) of the capture: its frames ``start``, ``start + every``, and so on.

    Raises:
        CaptureError: the capture does not have these frames.
    """
    check_step(every)
    available = -(-(len(source) - start) // every)
    length = available if frames is None else frames
    if start < 0 or length < 1 or length > available:
        counted = "" if every == 1 else f", counting 1 in {every}"
        raise CaptureError(
            f"The capture {source.name} has {len(source)} frames; got start {start} and "
            f"{'all' if frames is None else frames} frames{counted}. Choose a range inside the capture."
        )
    if every != 1 and start:
        source, start = Section(source, start, len(source) - start), 0
    source = every_nth_frame(source, every)
    return source if (start, length) == (0, len(source)) else Section(source, start, length)


def select_cameras(source: FrameSource, names: tuple[str, ...]) -> FrameSource:
    """The capture restricted to these cameras, so that other pictures are not decoded.

    A rig needs two cameras, so with a single name another camera is included. Sources of an unknown type are returned
    unchanged. Nothing is held out in the result.
    """
    selected = names if len(names) > 1 else (*names, *[name for name in source.rig if name not in names][:1])
    rig = CameraRig({name: source.rig[name] for name in source.rig if name in selected})
    if isinstance(source, ImageSource | VideoSource):
        return replace(source, rig=rig)
    if isinstance(source, WithRig):
        return replace(source, source=select_cameras(source.source, names), other=rig)
    return replace(source, source=select_cameras(source.source, names)) if isinstance(source, SourceWrapper) else source


@dataclass(frozen=True)
class EveryNthFrame(SourceWrapper):
    """Every ``step``-th frame, counted from 0, at ``rate`` frames a second; None for a ``step``-th of the source's."""

    step: int
    rate: float | None = None

    @property
    def fps(self) -> float:
        return self.source.fps / self.step if self.rate is None else self.rate

    def __len__(self) -> int:
        return -(-len(self.source) // self.step)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        wanted = range(start * self.step, len(self.source), self.step)
        for index, frame in enumerate(self._read(wanted), start):
            yield replace(frame, index=index, pts_seconds=index / self.fps)

    def _read(self, wanted: range) -> Iterator[MultiViewFrame]:
        """The source's frames of these numbers."""
        if isinstance(innermost(self.source), ImageSource):
            for number in wanted:  # files of those between need not be opened
                yield from islice(self.source.frames(number), 1)
        elif wanted:  # a seek in a video decodes from its key frame on, which is mostly farther back
            yield from islice(self.source.frames(wanted.start), 0, wanted[-1] - wanted.start + 1, self.step)


def every_nth_frame(source: FrameSource, step: int, *, rate: float | None = None) -> FrameSource:
    """Every ``step``-th frame of the capture, from the first; ``rate`` as of :class:`EveryNthFrame`."""
    check_step(step)
    return source if step == 1 else EveryNthFrame(source, step, rate)


def check_step(step: int) -> None:
    """Check the step from one frame that is used to the next."""
    if step < 1:
        raise ConfigError(f"The step between frames (--every) must be at least 1, got {step}; 1 uses each frame.")


AHEAD = 2  # frames; each costs its pictures' bytes


@dataclass(frozen=True)
class Prefetch(SourceWrapper):
    """The same frames, :data:`AHEAD` of them decoded ahead in a background thread."""

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """The frames from stream index ``start``; see :class:`~structgstream.lookahead.Lookahead`."""
        with Lookahead(self.source.frames(start), depth=AHEAD) as frames:
            yield from frames

    def frames_after(self) -> Iterator[MultiViewFrame]:
        return self.source.frames_after() if isinstance(self.source, SourceWrapper) else iter(())


def read_ahead(source: FrameStream) -> FrameStream:
    """A recording decoded ahead; a live source, which has threads and queues of its own, as it is."""
    return Prefetch(source) if is_recording(source) else source


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
            if index >= self._next:
                return None
        with closed(self._source.frames(index)) as frames:  # one of before
            return next(frames, None)

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
            with closed(frames):
                pass

    def _read(self) -> None:
        """Reads a frame without the lock, so that others may take cached ones."""
        self._reading = True
        if self._frames is None:
            self._frames = self._source.frames(self._next)
        frames, found = self._frames, None
        self._changed.release()
        try:
            found = next(frames, None)
        except BaseException as error:  # raised in every reader
            self._failed = error
        finally:
            self._changed.acquire()
            self._reading, self._ended = False, found is None
            if found is not None:
                self._cached[self._next] = found
                self._next += 1
            self._changed.notify_all()

    def _retain(self) -> None:
        firsts = dict.fromkeys(first for first, _ in self._needs)
        retain_frames(self._source, *firsts, last=max(last for _, last in self._needs))


class _Reader(SourceFacts[FrameStream]):
    """One of several readers of a stream."""

    def __init__(self, shared: SharedFrames, source: FrameStream, number: int) -> None:
        self._shared, self.source, self._number = shared, source, number

    def retain(self, *first: int, last: int) -> None:
        """See ``RetainsFrames``; it needs one frame."""
        self._shared.retain(self._number, *first, last=last)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """The frames from ``start`` on; one that was the last asked for may be asked for again."""
        index = start
        while (frame := self._shared.take(self._number, index)) is not None:
            yield frame
            index += 1


class _RecordingReader(_Reader):
    """One of several readers of a recording."""

    def __len__(self) -> int:
        return len(self.source)  # type: ignore[arg-type]
