# SPDX-License-Identifier: Apache-2.0
"""Records work on a GPU once and then repeats it with a single launch (CUDA graphs).

Note [Recorded work]
~~~~~~~~~~~~~~~~~~~~
A graph repeats the same kernels on the same memory. So recorded work must not wait for the GPU, and its shapes must not
depend on data (``kernels.backend.nonblocking``). It reads values that differ between replays, such as a learning rate,
from tensors that are written in between. Recording runs nothing; each replay overwrites the result tensors. Recordings
share their memory: temporary memory of one may be the result of another, so a result is valid until the next replay of
any recording.
"""

import warnings
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import Any, Generic, Protocol, TypeVar

import torch

Result = TypeVar("Result")


class Recorder(Protocol[Result]):
    """Records work by key and repeats it (Note [Recorded work])."""

    @property
    def replays(self) -> int:
        """Number of replays so far."""
        ...

    def __len__(self) -> int:
        """Number of recordings."""
        ...

    def __contains__(self, key: Hashable) -> bool:
        """Whether work was recorded under ``key``."""
        ...

    def record(self, key: Hashable, work: Callable[[], Result]) -> None:
        """Record ``work``; none of its operations run."""
        ...

    def replay(self, key: Hashable) -> Result:
        """Run what was recorded under ``key``; its result is valid until the next replay of any key."""
        ...


class GraphMemory:
    """A CUDA stream and memory for graphs, shared by all recorders of a back-end; reserved at the first recording.

    A pool returns its memory to the driver when its last graph is deleted, and each frame would have to allocate it
    again. Therefore one empty graph is retained.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._reserved: tuple[torch.cuda.Stream, Any, torch.cuda.CUDAGraph] | None = None

    def recorder(self) -> "GraphRecorder[Any]":
        """A recorder, which owns its graphs."""
        return GraphRecorder(self)

    def capture(self, work: Callable[[], Result]) -> tuple[torch.cuda.CUDAGraph, Result]:
        """A graph of ``work`` and its result."""
        if self._reserved is None:
            stream, pool = torch.cuda.Stream(self._device), torch.cuda.graph_pool_handle()
            nothing = torch.zeros((), device=self._device)
            self._reserved = stream, pool, _captured(stream, pool, nothing.zero_)[0]
        stream, pool, _ = self._reserved
        return _captured(stream, pool, work)


def _captured(stream: torch.cuda.Stream, pool: Any, work: Callable[[], Result]) -> tuple[torch.cuda.CUDAGraph, Result]:
    # torch.cuda.graph would wait for the GPU and return all its free memory at every recording.
    graph = torch.cuda.CUDAGraph()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        # Other threads prepare the next frame on the GPU meanwhile.
        graph.capture_begin(pool=pool, capture_error_mode="thread_local")
        try:
            result = work()
        except BaseException:
            # The recording is invalid or empty; the error that caused it is the one to report.
            with suppress(RuntimeError), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                graph.capture_end()
            raise
        graph.capture_end()
    return graph, result


class GraphRecorder(Generic[Result]):
    """Records into CUDA graphs; see :class:`Recorder`."""

    def __init__(self, memory: GraphMemory) -> None:
        self.replays = 0
        self._memory = memory
        self._recorded: dict[Hashable, tuple[torch.cuda.CUDAGraph, Result]] = {}

    def __len__(self) -> int:
        return len(self._recorded)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._recorded

    def record(self, key: Hashable, work: Callable[[], Result]) -> None:
        """See :meth:`Recorder.record`."""
        self._recorded[key] = self._memory.capture(work)

    def replay(self, key: Hashable) -> Result:
        """See :meth:`Recorder.replay`."""
        graph, result = self._recorded[key]
        graph.replay()
        self.replays += 1
        return result
