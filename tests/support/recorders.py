# SPDX-License-Identifier: Apache-2.0
"""A recorder without a GPU: work is done again instead of queued again, with the arguments of its recording.

As with CUDA graphs that share memory, a result lasts until the next replay: then it is not a number.
"""

from collections.abc import Callable, Hashable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor


class Repeater:
    """As a CUDA graph does, it writes every time into the tensors of its first result, and over those of others.

    Args:
        keys: in the order of their replays.
    """

    def __init__(self) -> None:
        self.keys: list[Hashable] = []
        self._work: dict[Hashable, Callable[[], Any]] = {}
        self._results: dict[Hashable, Any] = {}

    @property
    def replays(self) -> int:
        return len(self.keys)

    def __len__(self) -> int:
        return len(self._work)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._work

    def record(self, key: Hashable, work: Callable[[], Any]) -> None:
        assert key not in self._work, f"{key} is recorded already"
        self._work[key] = work

    def replay(self, key: Hashable) -> Any:
        self.keys.append(key)
        result = self._work[key]()
        now = [value.clone() for value in _numbers(result)]
        with torch.no_grad():
            for earlier in self._results.values():
                for tensor in _numbers(earlier):
                    tensor.fill_(torch.nan)
            for into, value in zip(_numbers(self._results.setdefault(key, result)), now, strict=True):
                into.copy_(value)
        return self._results[key]


def _numbers(value: Any) -> Iterator[Tensor]:
    """The tensors ``[]`` of a result."""
    if isinstance(value, Tensor):
        if value.dim() == 0:
            yield value
    elif isinstance(value, dict | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _numbers(part)
    elif is_dataclass(value):
        for f in fields(value):
            yield from _numbers(getattr(value, f.name))
