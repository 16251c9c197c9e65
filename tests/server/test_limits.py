# SPDX-License-Identifier: Apache-2.0
"""Counting what an address does."""

from hypothesis import given
from hypothesis import strategies as st

from structgstream.server.limits import Concurrent, TokenBuckets, client_key


class Clock:
    """Seconds that the test moves."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def test_a_bucket_empties_and_fills() -> None:
    clock = Clock()
    buckets = TokenBuckets(2.0, 3, most=10, clock=clock)
    assert [buckets.wait_seconds("a") for _ in range(5)] == [0.0, 0.0, 0.0, 0.5, 0.5]
    assert buckets.wait_seconds("b") == 0.0
    clock.seconds = 0.5
    assert [buckets.wait_seconds("a") for _ in range(2)] == [0.0, 0.5]
    clock.seconds = 100.0
    assert [buckets.wait_seconds("a") for _ in range(4)] == [0.0, 0.0, 0.0, 0.5]


@given(st.lists(st.floats(0.0, 5.0), max_size=60), st.floats(0.1, 10.0), st.integers(1, 10))
def test_no_more_is_granted_than_burst_and_rate_allow(steps: list[float], per_second: float, burst: int) -> None:
    clock, granted = Clock(), 0
    buckets = TokenBuckets(per_second, burst, most=10, clock=clock)
    for step in steps:
        clock.seconds += step
        granted += buckets.wait_seconds("a") == 0.0
    assert granted <= burst + per_second * clock.seconds + 1e-6


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=30))
def test_who_waits_as_told_is_granted(steps: list[float]) -> None:
    clock = Clock()
    buckets = TokenBuckets(0.7, 2, most=10, clock=clock)
    for step in steps:
        clock.seconds += step
        if wait := buckets.wait_seconds("a"):
            clock.seconds += wait + 1e-9
            assert buckets.wait_seconds("a") == 0.0


def test_addresses_are_forgotten_and_memory_is_bounded() -> None:
    buckets = TokenBuckets(0.001, 1, most=100, clock=Clock())
    assert buckets.wait_seconds("first") == 0.0
    assert buckets.wait_seconds("first") > 0.0
    for i in range(1000):
        buckets.wait_seconds(str(i))
    assert len(buckets) == 100
    assert buckets.wait_seconds("first") == 0.0


def test_what_one_client_is() -> None:
    assert client_key("192.0.2.1") == "192.0.2.1"
    assert client_key("2001:db8:1:2::1") == client_key("2001:db8:1:2:ffff::9") != client_key("2001:db8:1:3::1")
    assert client_key("::ffff:192.0.2.1") == "192.0.2.1"
    assert client_key("") == ""
    assert len(client_key("x" * 10_000)) == 64


def test_how_many_at_a_time() -> None:
    counts = Concurrent(2, most_together=3)
    assert [counts.enter("a"), counts.enter("a"), counts.enter("a")] == [True, True, False]
    assert [counts.enter("b"), counts.enter("c")] == [True, False]
    counts.leave("a")
    assert counts.enter("c")
    for client in ("a", "b", "c"):
        counts.leave(client)
    assert counts.total == 0
    assert counts.enter("a")
