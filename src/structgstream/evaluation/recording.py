# SPDX-License-Identifier: Apache-2.0
"""The protocol of files that can be evaluated: one drawable per frame, of this method or another."""

from collections.abc import Iterator, Sequence
from typing import Protocol, runtime_checkable

import torch

from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import StreamHeader
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
