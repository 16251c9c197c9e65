# SPDX-License-Identifier: Apache-2.0
"""When further iterations of a frame would not help: as many as there is change, instead of a fixed number."""

from collections import deque

import torch
from torch import Tensor


class EarlyStopping:
    """Watches how much lower each view's loss is than when the view was looked at last.

    Args:
        least_gain: a frame has settled when its views gain less than this share of their loss on average; 0: never.
        views: how many there are. Gains are averaged over half a pass through them.
    """

    def __init__(self, least_gain: float, views: int) -> None:
        self._least_gain = least_gain
        self._last: dict[int, Tensor] = {}
        self._gains: deque[Tensor] = deque(maxlen=max(1, views // 2))
        self._added = 0

    def add(self, view_index: int, loss: Tensor) -> None:
        """Note the loss ``[]`` of a view before the step that it led to."""
        last, self._last[view_index] = self._last.get(view_index), loss.detach()
        self._added += 1
        if last is not None:
            self._gains.append(1.0 - loss.detach() / last.clamp(min=1e-12))

    def reset(self) -> None:
        """What there is to gain has changed."""
        self._gains.clear()

    @property
    def should_stop(self) -> bool:
        """Whether there is little more to gain; asked for every few views only, since a GPU has to be waited for."""
        full = len(self._gains) == self._gains.maxlen
        if self._least_gain <= 0.0 or not full or self._added % max(1, len(self._gains) // 3):
            return False
        return float(torch.stack(list(self._gains)).mean()) < self._least_gain
