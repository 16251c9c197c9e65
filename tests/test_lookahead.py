# SPDX-License-Identifier: Apache-2.0
import threading
from collections.abc import Iterator

import pytest

from structgstream.lookahead import Lookahead

WAIT_SECONDS = 10.0


def test_items_come_in_order_and_end() -> None:
    with Lookahead(iter(range(5))) as ahead:
        assert list(ahead) == [0, 1, 2, 3, 4]
        assert next(ahead, "end") == "end"


def test_the_next_item_is_made_while_one_is_worked_on_and_no_further() -> None:
    made = [threading.Event() for _ in range(3)]

    def items() -> Iterator[int]:
        for number, event in enumerate(made):
            event.set()
            yield number

    with Lookahead(items()) as ahead:
        assert next(ahead) == 0
        assert made[1].wait(WAIT_SECONDS)
        assert not made[2].wait(0.05)


def test_an_error_is_raised_when_its_item_is_asked_for() -> None:
    def items() -> Iterator[int]:
        yield 0
        raise ValueError("a bad picture")

    with Lookahead(items()) as ahead:
        assert next(ahead) == 0
        with pytest.raises(ValueError, match="a bad picture"):
            next(ahead)
        assert next(ahead, None) is None


def test_leaving_early_waits_for_the_maker_and_closes_the_items() -> None:
    going, may_go_on, closed = threading.Event(), threading.Event(), []

    def items() -> Iterator[int]:
        try:
            yield 0
            going.set()
            may_go_on.wait(WAIT_SECONDS)
            yield 1
            yield 2
        finally:
            closed.append(threading.current_thread())

    def work() -> None:
        with Lookahead(items()) as ahead:
            assert next(ahead) == 0
            assert going.wait(WAIT_SECONDS)
            threading.Timer(0.05, may_go_on.set).start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert closed == [threading.main_thread()]
    assert not any(thread.name.startswith("lookahead") for thread in threading.enumerate())


def test_without_looking_ahead_an_item_is_made_when_it_is_asked_for() -> None:
    made: list[int] = []

    def items() -> Iterator[int]:
        for number in range(3):
            made.append(number)
            yield number

    with Lookahead(items(), depth=0) as asked:
        assert made == []
        assert next(asked) == 0
        assert made == [0]
        assert list(asked) == [1, 2]
