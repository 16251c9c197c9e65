# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C arrives, also where something on the way loses it; of two signals the first asks, the second ends."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from typing import Any

import pytest

from structgstream.cli.app import StopSignal, Terminated, interruptible

LONG = 60.0


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(autouse=True)
def as_in_a_terminal() -> Iterator[None]:
    """A shell ignores Ctrl-C in what it runs in the background, which tests may be."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    clean = untouched()
    signal.signal(signal.SIGINT, before)
    assert clean


def untouched() -> bool:
    left = signal.getitimer(signal.ITIMER_REAL)
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGALRM)
    return (left, *handlers) == ((0.0, 0.0), signal.default_int_handler, signal.SIG_DFL)


def test_ctrl_c_leaves_the_block() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible():
        press()


def test_an_error_that_is_made_of_it_is_ctrl_c() -> None:
    def library() -> None:
        try:
            press()
        except KeyboardInterrupt:
            raise RuntimeError("Cannot import the backend") from None

    with pytest.raises(KeyboardInterrupt) as found, interruptible():
        library()
    assert isinstance(found.value.__cause__, RuntimeError)


def test_what_swallows_it_gets_it_again() -> None:
    def library() -> None:
        for _ in range(3):
            with suppress(KeyboardInterrupt):
                press()
        time.sleep(LONG)

    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt), interruptible(again_seconds=0.05):
        library()
    assert time.monotonic() - begun < LONG


def test_a_block_that_ends_meanwhile_was_interrupted_all_the_same() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible(), suppress(KeyboardInterrupt):
        press()


def test_without_ctrl_c_nothing_is_changed() -> None:
    with interruptible():
        pass
    with pytest.raises(RuntimeError, match="of its own"), interruptible():
        raise RuntimeError("of its own")


def test_ignored_as_under_nohup_it_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interruptible():
            press()
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("block", [interruptible, StopSignal])
def test_another_thread_has_no_signals(block: Callable[[], AbstractContextManager[Any]]) -> None:
    before, seen = signal.getsignal(signal.SIGTERM), []

    def run() -> None:
        with block():
            seen.append((signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [(signal.default_int_handler, before)]
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    ("number", "raised", "said"),
    [(signal.SIGTERM, Terminated, ""), (signal.SIGINT, KeyboardInterrupt, "Ends after this frame; Ctrl-C again")],
)
def test_the_first_signal_is_remembered_and_the_second_ends(
    number: signal.Signals, raised: type[BaseException], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before, asked = signal.getsignal(number), []
    with StopSignal(lambda: asked.append(True), number=number) as ending:
        ending.end(whole=False)
        os.kill(os.getpid(), number)
        assert (ending.asked, asked) == (True, [True])
        assert capsys.readouterr().err.startswith(said)
        ending.end(whole=True)
        with pytest.raises(raised):
            ending.end(whole=False)
        with pytest.raises(raised):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


def test_what_was_there_before_comes_back_however_the_block_ends() -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    try:
        with StopSignal():
            pass
        with pytest.raises(KeyError), StopSignal():
            raise KeyError
        os.kill(os.getpid(), signal.SIGTERM)
        assert heard == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)
