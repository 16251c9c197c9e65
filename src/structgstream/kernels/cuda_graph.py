# SPDX-License-Identifier: Apache-2.0
"""Records work on a GPU once and queues it again with new numbers, as one launch.

A graph repeats the same kernels on the same memory. So what is recorded must not wait for the GPU and must not take its
shapes from numbers (``backend.without_waiting``), inputs are copied into the memory that was recorded, and outputs lie
where they lay.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError

_log = logging.getLogger(__name__)

WARM_UP_CALLS = 3
"""Before recording: libraries load, compile and take their workspaces at their first calls, which no graph may hold."""

Recorder = Callable[[Callable[[], Any]], tuple[Callable[[], None], Any]]
"""Runs a body, possibly often; returns what queues it again, and its outputs."""


def record_on_gpu(body: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
    """A recorder that makes a CUDA graph."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(WARM_UP_CALLS):
            body()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        outputs = body()
    return graph.replay, outputs


@dataclass(frozen=True)
class Captured:
    """A recorded function. Its outputs are overwritten by the next call.

    Args:
        inputs: the memory that the graph reads.
        outputs: what the function returned while it was recorded.
        replay: queues the graph.
    """

    inputs: tuple[Tensor, ...]
    outputs: Any
    replay: Callable[[], None]

    def __call__(self, *values: Tensor) -> Any:
        """Copy ``values`` in and queue the graph; nothing waits.

        Raises:
            BackendError: other shapes or precisions than were recorded.
        """
        expected = [(tuple(value.shape), value.dtype) for value in self.inputs]
        got = [(tuple(value.shape), value.dtype) for value in values]
        if got != expected:
            raise BackendError(f"The graph was recorded for inputs {expected}, got {got}; record another one.")
        with torch.no_grad():
            for static, value in zip(self.inputs, values, strict=True):
                static.copy_(value, non_blocking=True)
        self.replay()
        return self.outputs


def captured(
    function: Callable[..., Any],
    example: Sequence[Tensor],
    *,
    state: Sequence[Tensor] = (),
    record: Recorder = record_on_gpu,
) -> Callable[..., Any]:
    """``function`` of tensors, recorded; without a GPU the function itself, and the log says so.

    Args:
        function: takes tensors of fixed shapes, returns tensors.
        example: inputs to record with; their values do not matter.
        state: tensors that the function changes in place: recording leaves them as they were.
        record: makes the graph.
    """
    if record is record_on_gpu and not torch.cuda.is_available():
        _log.warning("Nothing is recorded without an NVIDIA GPU: each call runs step by step.")
        return function
    inputs = tuple(value.detach().clone() for value in example)
    before = [value.detach().clone() for value in state]
    replay, outputs = record(lambda: function(*inputs))
    with torch.no_grad():
        for value, old in zip(state, before, strict=True):
            value.detach().copy_(old)
    return Captured(inputs, outputs, replay)
