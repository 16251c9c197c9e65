# SPDX-License-Identifier: Apache-2.0
"""Prefetching: a background thread computes the next item while the current one is processed."""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, TypeVar

T = TypeVar("T")


class Lookahead(Generic[T]):
    """An iterator over ``items`` that prefetches one item.

    With ``ahead=False`` nothing is prefetched: each item is computed in the call that requests it.

    An exception raised by ``items`` surfaces from the ``next`` call that would have returned that item. Leaving the
    ``with`` block waits for the item being computed, and calls ``items.close`` if it exists.
    """

    def __init__(self, items: Iterator[T], *, ahead: bool = True) -> None:
        self._items = items
        self._ahead = ahead
        self._maker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lookahead")
        self._next: Future[tuple[T] | None] | None = None

    def __enter__(self) -> "Lookahead[T]":
        if self._ahead:
            self._next = self._maker.submit(self._made)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._maker.shutdown(wait=True, cancel_futures=True)
        if close := getattr(self._items, "close", None):
            close()

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        """Returns the prefetched item, waiting for it if necessary, and starts the one after it.

        Raises:
            StopIteration: there is none.
        """
        if not self._ahead:
            return next(self._items)
        if self._next is None:
            raise StopIteration
        ready, self._next = self._next, None
        found = ready.result()
        if found is None:
            raise StopIteration
        self._next = self._maker.submit(self._made)
        return found[0]

    def _made(self) -> tuple[T] | None:
        # A future cannot raise StopIteration.
        for item in self._items:
            return (item,)
        return None
