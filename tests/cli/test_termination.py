# SPDX-License-Identifier: Apache-2.0
"""The first SIGTERM asks, the second ends."""

import os
import signal
import threading

import pytest

from structgstream.cli.app import Terminated, Termination


def send() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def test_the_first_signal_is_remembered_and_the_second_ends() -> None:
    before, asked = signal.getsignal(signal.SIGTERM), []
    with Termination(lambda: asked.append(True)) as ending:
        assert not ending.asked
        send()
        assert (ending.asked, asked) == (True, [True])
        with pytest.raises(Terminated, match="was given up"):
            send()
    assert signal.getsignal(signal.SIGTERM) is before


def test_what_was_there_before_comes_back_however_the_block_ends() -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    try:
        with Termination():
            pass
        with pytest.raises(KeyError), Termination():
            raise KeyError
        send()
        assert heard == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_another_thread_has_no_signals_and_changes_nothing() -> None:
    before, found = signal.getsignal(signal.SIGTERM), []

    def run() -> None:
        with Termination() as ending:
            found.append((ending.asked, signal.getsignal(signal.SIGTERM)))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [(False, before)]
    assert signal.getsignal(signal.SIGTERM) is before
