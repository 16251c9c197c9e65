# SPDX-License-Identifier: Apache-2.0
"""Signals: SIGTERM ends a run after the frame being fitted, Ctrl-C interrupts at once, whatever library is running."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


AGAIN_SECONDS = 3.0


@contextmanager
def interruptible(*, again_seconds: float = AGAIN_SECONDS) -> Iterator[None]:
    """Within this block Ctrl-C is a ``KeyboardInterrupt`` that leaves it.

    Libraries lose it: one that is loaded at the moment makes an error of its own of it (pycolmap does), a callback from
    C drops it. So an error after Ctrl-C counts as Ctrl-C, and a block that goes on is interrupted again. Only for work
    whose results are there whole or not at all, as what cleans up is interrupted again, too.

    Outside of the main thread, and where Ctrl-C is ignored (``nohup``), the block changes nothing.

    Args:
        again_seconds: after which a block that goes on is interrupted again.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    asked = False

    def interrupted(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.setitimer(signal.ITIMER_REAL, again_seconds, again_seconds)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupted)
    alarm = signal.signal(signal.SIGALRM, interrupted)
    try:
        yield
    except Exception as error:
        if not asked:
            raise
        raise KeyboardInterrupt from error
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGINT, before)
        signal.signal(signal.SIGALRM, alarm)
    if asked:
        raise KeyboardInterrupt
