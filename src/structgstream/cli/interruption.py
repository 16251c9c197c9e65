# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C that arrives, whatever it meets on its way."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

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
