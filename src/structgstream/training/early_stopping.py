# SPDX-License-Identifier: Apache-2.0
"""Early stopping of a frame's optimisation."""

from collections import deque

import torch
from torch import Tensor


class EarlyStopping:
    """Tracks the relative decrease of each view's loss since the view's previous iteration.

    Args:
        least_gain: stop when the mean decrease is below this share of the loss; 0: never.
        views: number of views. The mean is over half a pass through them.
    """

    def __init__(self, least_gain: float, views: int) -> None:
        self._least_gain = least_gain
        self._last: dict[int, Tensor] = {}
        self._gains: deque[Tensor] = deque(maxlen=max(1, views // 2))
        self._added = 0

    def add(self, view_index: int, loss: Tensor) -> None:
        """Record the loss ``[]`` of a view, computed before its step."""
        if self._least_gain <= 0.0:
            return
        # A copy, since a recorded iteration writes its losses into the same tensors again.
        loss = loss.detach().clone()
        last, self._last[view_index] = self._last.get(view_index), loss
        self._added += 1
        if last is not None:
            self._gains.append(1.0 - loss / last.clamp(min=1e-12))

    def reset(self) -> None:
        """Restart the average, after the scene was changed by patching."""
        self._gains.clear()

    @property
    def should_stop(self) -> bool:
        """Whether to stop; evaluated every few views only, because reading losses synchronises with a GPU."""
        full = len(self._gains) == self._gains.maxlen
        if self._least_gain <= 0.0 or not full or self._added % max(1, len(self._gains) // 3):
            return False
        return float(torch.stack(list(self._gains)).mean()) < self._least_gain
