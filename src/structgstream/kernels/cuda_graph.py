# SPDX-License-Identifier: Apache-2.0
"""Work on a GPU that is recorded once and then queued again as one launch (CUDA graphs).

Note [Recorded work]
~~~~~~~~~~~~~~~~~~~~
A graph repeats the same kernels on the same memory. So recorded work must not wait for the GPU, must not take its
shapes from numbers (``kernels.backend.nonblocking``), and reads what differs from one time to the next, such as a
learning rate, from a tensor that is written in between. Recording runs nothing; the results are tensors that each
replay writes anew. Recordings share their memory: what one of them needs for a moment may be another's result, so that
a result lasts until the next replay of any.
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
        """How often recorded work was run."""
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
        """Run what was recorded under ``key``; its result lasts until the next replay of any key."""
        ...


class GraphMemory:
    """A stream and memory for graphs, shared by all recorders of a back-end; reserved at the first recording.

    Memory of a pool goes back to the driver when its last graph is gone, so that each frame would have to ask for it
    anew. Therefore one graph that does nothing stays.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._reserved: tuple[torch.cuda.Stream, Any, torch.cuda.CUDAGraph] | None = None

    def recorder(self) -> "GraphRecorder[Any]":
        """A recorder whose graphs live as long as it."""
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
    # torch.cuda.graph would wait for the GPU and give all its free memory back at every recording.
    graph = torch.cuda.CUDAGraph()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        # Other threads prepare the next frame on the GPU meanwhile.
        graph.capture_begin(pool=pool, capture_error_mode="thread_local")
        try:
            result = work()
        except BaseException:
            # The recording is spoilt, or empty; what spoilt it is the error to tell.
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
