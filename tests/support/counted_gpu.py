# SPDX-License-Identifier: Apache-2.0
"""The cuda back-end on the pretended device, which counts what a host queues for it and what it waits for.

Its own kernels run in their emulation.
"""

import ctypes
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from benchmarks.stages import mapped
from structgstream.kernels import backend as backends
from structgstream.kernels import cuda_fit
from structgstream.kernels.backend import Backend, kernel_functions, reference_backend
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import FitFrame
from tests.support.pretended_gpu import DEVICE, lies_there, pretended_device, values_of

_VIEWS = (
    "view _unsafe_view expand permute t transpose select slice unsqueeze squeeze alias detach as_strided split "
    "split_with_sizes unbind narrow _reshape_alias lift_fresh unfold diagonal empty empty_like new_empty "
    "empty_strided new_empty_strided resize_ view_as reshape movedim swapaxes is_same_size lift set_"
)
_WAITS = frozenset(("_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "unique_dim"))
_LAUNCHES = {"sort": 6, "argsort": 6, "cumsum": 2, "nonzero": 4, "_unique2": 10, "unique_dim": 14, "median": 4}
"""Launches of operations that have more than one."""


@dataclass
class Counts:
    """Operations that a host queues and times that it waits, by name, and launches of the native fit."""

    operations: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)
    pauses: int = 0

    def add(self, name: str, operations: int = 1, waits: int = 0) -> None:
        """Count an operation, unless counting is paused."""
        if self.pauses == 0:
            self.operations[name] += operations
            self.waits[name] += waits

    def see(self, func: Any, args: Any, kwargs: Any, found: Any) -> None:
        """Count what the dispatcher runs, if it runs on the device."""
        there = any(lies_there(leaf) for leaf in tree_leaves((args, kwargs)))
        name = func._schema.name.removeprefix("aten::")
        if not (there or any(lies_there(leaf) for leaf in tree_leaves(found))) or name in _VIEWS.split():
            return
        indices = args[1] if name in ("index", "index_put", "index_put_", "_index_put_impl_") else ()
        by_mask = any(lies_there(i) and i.dtype in (torch.bool, torch.uint8) for i in indices or ())
        to_host = there and name == "_to_copy" and not any(lies_there(leaf) for leaf in tree_leaves(found))
        to_host = to_host and not (kwargs or {}).get("non_blocking")  # ``kernels.backend.on_processor`` waits once.
        self.add(name, 5 if by_mask else _LAUNCHES.get(name, 1), int(name in _WAITS or by_mask or to_host))

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Nothing is counted within."""
        self.pauses += 1
        try:
            yield
        finally:
            self.pauses -= 1


class _Library(KernelLibrary):
    """The emulated kernels on tensors of the pretended device; a call is as many operations as it has launches, each of
    which has a copy of the views' arguments where it is for several views."""

    counts: Counts

    def call(self, name: str, *arguments: Any, device: torch.device) -> None:
        several = {
            "sgs_cuda_anchor_inputs": 2,
            "sgs_cuda_l1_ssim": 2,
            "sgs_cuda_reached_tiles": 2,
            "sgs_cuda_views": 16,
            "sgs_cuda_raster_new": 8,  # with statics
            "sgs_cuda_raster_backward": 2,
        }
        waits = name in ("sgs_cuda_views", "sgs_cuda_raster_new")
        self.counts.add(name, several.get(name, 1), waits=int(waits))
        super().call(name, *(values_of(argument) for argument in arguments), device=device)

    def addresses(self, *tensors: Tensor | None) -> list[int | None]:
        return super().addresses(*map(values_of, tensors))

    def check_devices(self, *tensors: Tensor | None) -> None:
        assert all(tensor is None or lies_there(tensor) for tensor in tensors)


def _counted_iterations(library: KernelLibrary, counts: Counts, frame: FitFrame) -> Callable[[int, int], None]:
    """The native iterations, which are one operation and one wait for each call."""
    counts.add("iterations begin", waits=1)
    with counts.paused():
        run = cuda_fit.iterations(library, mapped(frame, values_of))

    def counted(first: int, last: int) -> None:
        counts.add("iterations", waits=1)
        run(first, last)

    return counted


@contextmanager
def counted_gpu(
    emulation: ctypes.CDLL, patch: pytest.MonkeyPatch, *, native: bool = True
) -> Iterator[tuple[Backend, Counts]]:
    """The cuda back-end on ``DEVICE`` within, and what was counted there so far.

    Args:
        emulation: the kernels on the processor.
        patch: to count where the host waits.
        native: with the iterations of ``kernels.cuda_fit``; else they run in torch.
    """
    counts = Counts()
    library = _Library(emulation, DEVICE.type, lambda device: 0)
    object.__setattr__(library, "counts", counts)
    patch.setattr(backends, "wait_for", lambda device: counts.add("wait", 0, waits=int(device == DEVICE)))
    plain = KernelLibrary(emulation, "cpu", lambda device: 0)
    backend = replace(
        reference_backend(),
        name="cuda",
        device=DEVICE,
        iterations=partial(_counted_iterations, plain, counts) if native else None,
    ).with_functions(**kernel_functions(library))
    with pretended_device(counts.see):
        yield backend, counts
