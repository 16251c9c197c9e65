# SPDX-License-Identifier: Apache-2.0
"""A value that several ask for is computed once; what it is good for stands in ``test_recording``."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from structgstream.qualities import Once


def test_who_asks_first_makes_it() -> None:
    once, made = Once[str](2), []

    def make(text: str) -> str:
        made.append(text)
        return text

    assert once.value(1, lambda: make("a")) == ("a", True)
    assert once.value(1, lambda: make("b")) == ("a", False)
    once.value(2, lambda: make("c"))
    once.value(3, lambda: make("d"))
    assert once.value(1, lambda: make("e")) == ("e", True), "only so many are kept"
    once.clear()
    assert once.value(3, lambda: make("f")) == ("f", True)
    assert made == ["a", "c", "d", "e", "f"]


def test_others_wait_for_it_and_not_for_something_else() -> None:
    once, may_end = Once[int](2), threading.Event()

    def slow() -> int:
        assert may_end.wait(20)
        return 1

    with ThreadPoolExecutor(2) as threads:
        both = [threads.submit(once.value, "slow", slow) for _ in range(2)]
        assert once.value("quick", lambda: 2) == (2, True)
        assert not any(one.done() for one in both)
        may_end.set()
        assert sorted(one.result() for one in both) == [(1, False), (1, True)]


def test_an_error_is_reported_and_not_kept() -> None:
    once = Once[int](2)

    def fails() -> int:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        once.value(1, fails)
    assert once.value(1, lambda: 3) == (3, True)
