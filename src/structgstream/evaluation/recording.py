# SPDX-License-Identifier: Apache-2.0
"""Recordings that can be evaluated (one drawable per frame, of this method or another), and the captures of streams."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch

from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import StreamHeader
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import resized, section
from structgstream.errors import BackendError
from structgstream.scene.render import Drawable
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device


@runtime_checkable
class Movable(Drawable, Protocol):
    """A drawable whose tensors can be moved to another device."""

    def on_device(self, device: torch.device) -> Drawable: ...


class Recording(Protocol):
    """An opened file with one packet per frame, such as a ``StreamReader``.

    ``scenes`` decodes a drawable in normalised units frame by frame. ``complete`` states whether the run that wrote the
    file finished. The length of a drawable other than a ``Scene`` is its number of Gaussians. It needs ``on_device``
    (:class:`Movable`) to be drawn on another device than the CPU.
    """

    @property
    def header(self) -> StreamHeader: ...

    @property
    def packets(self) -> Sequence[PacketInfo]: ...

    @property
    def header_bytes(self) -> int: ...

    @property
    def total_bytes(self) -> int: ...

    @property
    def complete(self) -> bool: ...

    def scenes(self, start: int = 0) -> Iterator[tuple[PacketInfo, Drawable]]: ...


def to_device(drawable: Drawable, device: torch.device) -> Drawable:
    """The drawable with its tensors on ``device``.

    Raises:
        BackendError: it can only be drawn on the CPU.
    """
    if isinstance(drawable, Scene):
        return on_device(drawable, device)
    if device.type == "cpu":
        return drawable
    if not isinstance(drawable, Movable):
        raise BackendError(f"A {type(drawable).__name__} cannot be drawn on {device}; choose --device cpu.")
    return drawable.on_device(device)


def part_metadata(*, start: int, scale: float, every: int) -> dict[str, object]:
    """Metadata of a header on the part of a capture that a stream is made from; :func:`capture_of` reads it.

    Args:
        scale: size of the pictures relative to the stored ones.
        every: step between frames; 1 is left out, because older streams have no step.
    """
    part: dict[str, object] = {"start": start, "scale": scale}
    return part if every == 1 else part | {"every": every}


def capture_of(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource:
    """The part of the capture in ``folder`` that a stream was made from, at the stream's sizes.

    Args:
        frames: number of frames of the stream; None for all from the stream's first frame on.

    Raises:
        CaptureError: the folder contains no capture, or the capture ends before the stream's first frame.
    """
    whole = open_capture(folder)
    return _part(resized(whole, _scale(header, whole)), header, frames)


def stored_capture(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource | None:
    """As :func:`capture_of`, at the size of the stored pictures; None if these are not larger than the stream's.

    Raises:
        CaptureError: see :func:`capture_of`.
    """
    whole = open_capture(folder)
    return _part(whole, header, frames) if _scale(header, whole) < 1.0 else None


def _scale(header: StreamHeader, whole: FrameSource) -> float:
    shared = [name for name in header.rig if name in whole.rig.cameras]
    return min(header.rig[shared[0]].width / whole.rig[shared[0]].width, 1.0) if shared else 1.0


def _part(source: FrameSource, header: StreamHeader, frames: int | None) -> FrameSource:
    start, every = int(header.metadata.get("start", 0)), int(header.metadata.get("every", 1))
    left = -(-(len(source) - start) // every)
    return section(source, start=start, frames=left if frames is None else min(frames, left), every=every)
