# SPDX-License-Identifier: Apache-2.0
"""Prefetching: a background thread computes the next items while the current one is processed."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")


class Lookahead(Generic[T]):
    """An iterator over ``items`` that prefetches ``depth`` items, in order.

    With a depth of 0 nothing is prefetched: each item is computed in the thread that asks for it.

    An exception raised by ``items`` surfaces from the ``next`` call that would have returned that item. Leaving the
    ``with`` block waits for the item being computed, and calls ``items.close`` if it exists.
    """

    def __init__(self, items: Iterator[T], *, depth: int = 1) -> None:
        self._items = items
        self._depth = depth
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lookahead")
        self._pending: deque[Future[tuple[T] | None]] = deque()

    def __enter__(self) -> "Lookahead[T]":
        for _ in range(self._depth):
            self._pending.append(self._worker.submit(self._compute))
        return self

    def __exit__(self, *raised: object) -> None:
        self._worker.shutdown(wait=True, cancel_futures=True)
        if close := getattr(self._items, "close", None):
            close()

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        """Returns the next item, waiting for it if necessary, and starts another one. Raises StopIteration if there is
        none."""
        if not self._depth:
            return next(self._items)
        if not self._pending:
            raise StopIteration
        found = self._pending.popleft().result()
        if found is None:
            self._pending.clear()
            raise StopIteration
        self._pending.append(self._worker.submit(self._compute))
        return found[0]

    def _compute(self) -> tuple[T] | None:
        # A future cannot carry StopIteration.
        for item in self._items:
            return (item,)
        return None
