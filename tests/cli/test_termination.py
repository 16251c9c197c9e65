# SPDX-License-Identifier: Apache-2.0
"""The first SIGTERM or Ctrl-C asks, the second ends."""

import os
import signal
import threading

import pytest

from structgstream.cli.app import StopSignal, Terminated


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


def test_another_thread_has_no_signals_and_changes_nothing() -> None:
    before, found = signal.getsignal(signal.SIGTERM), []

    def run() -> None:
        with StopSignal() as ending:
            found.append((ending.asked, signal.getsignal(signal.SIGTERM)))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [(False, before)]
    assert signal.getsignal(signal.SIGTERM) is before
