# SPDX-License-Identifier: Apache-2.0
"""Seconds by stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class Stopwatch:
    """Adds up wall-clock seconds by stage name; synchronises with a GPU only if configured."""

    def __init__(self, device: torch.device, *, synchronise: bool = False) -> None:
        self.seconds: dict[str, float] = {}
        self._wait = synchronise and device.type == "cuda"

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body as part of stage ``name``."""
        started = time.perf_counter()
        try:
            yield
        finally:
            if self._wait:
                torch.cuda.synchronize()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
