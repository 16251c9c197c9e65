# SPDX-License-Identifier: Apache-2.0
"""SIGTERM, as a service manager sends it: the frame being fitted is finished, and the stream closed."""

import signal
from collections.abc import Callable
from types import FrameType


class Terminated(KeyboardInterrupt):
    """The process was asked to end, as by Ctrl-C; the message states what is stored and how to continue."""


class Termination:
    """Within its ``with`` block the first SIGTERM only sets :attr:`asked`; a second one ends the block at once.

    Only the main thread receives signals, so elsewhere the block changes nothing.

    Args:
        on_ask: called, in the signal's handler, at the first one: to wake what waits for frames.

    Raises:
        Terminated: at the second SIGTERM, wherever the block is.
    """

    def __init__(self, on_ask: Callable[[], object] = lambda: None) -> None:
        self.asked = False
        self._on_ask = on_ask
        self._before: object = None

    def __enter__(self) -> "Termination":
        try:
            self._before = signal.signal(signal.SIGTERM, self._handle)
        except ValueError:  # not the main thread
            self._before = None
        return self

    def __exit__(self, *raised: object) -> None:
        if callable(self._before) or isinstance(self._before, int):
            signal.signal(signal.SIGTERM, self._before)  # type: ignore[arg-type]

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise Terminated("The frame being fitted was given up.")
        self.asked = True
        self._on_ask()
