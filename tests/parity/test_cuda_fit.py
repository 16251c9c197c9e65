# SPDX-License-Identifier: Apache-2.0
"""The iterations of a later frame in the GPU's kernels, run on the processor: beside those of the cpu back-end, with
threads and blocks in both orders, and with too little room for gradients at first.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch

from benchmarks.gpu import copied
from structgstream.kernels import cpu_fit, cuda_fit
from structgstream.kernels.backend import Backend, cpu_backend
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import FitFrame
from structgstream.scene.state import state_of
from tests.parity.test_native_iterations import PLAIN, check_same_results, fitted
from tests.support.backends import needs_native

pytestmark = needs_native
PROCESSOR = torch.device("cpu")
Emulation = Callable[[int], KernelLibrary]


def emulated(emulation: Emulation, *, order: int = 0, slots: int | None = None) -> Backend:
    """The cpu back-end with the GPU's iterations."""
    return replace(cpu_backend(), iterations=partial(cuda_fit.iterations, emulation(order), slots=slots))


def first_frame(**options: Any) -> FitFrame:
    """What the iterations of a frame begin with."""
    found: list[FitFrame] = []

    def begin(frame: FitFrame) -> Callable[[int, int], None]:
        found.append(copied(frame, PROCESSOR))
        return cpu_fit.iterations(frame)

    fitted(replace(cpu_backend(), iterations=begin), **options)
    return found[0]


@pytest.mark.parametrize("options", [{}, {"appears": False, "free": 0}])
def test_pictures_and_gradients_are_those_of_the_cpu(emulation: Emulation, options: dict[str, Any]) -> None:
    frame = first_frame(**options)
    seen = set[int]()
    for i, number in enumerate(frame.plan.order.tolist()):
        if (number, bool(frame.plan.rests[i])) in seen:
            continue
        seen.add((number, bool(frame.plan.rests[i])))
        one, two = copied(frame, PROCESSOR), copied(frame, PROCESSOR)
        cpu_fit.iterations(one)(i, i + 1)
        cuda_fit.iterations(emulation(0), two)(i, i + 1)
        assert (one.views[number].image - two.views[number].image).abs().max() < 5e-6
        assert torch.allclose(one.plan.terms[i], two.plan.terms[i], rtol=1e-4)
        for mine, theirs in zip(one.leaves, two.leaves, strict=True):
            if mine is not None and theirs is not None and mine.first is not None and theirs.first is not None:
                assert (mine.first - theirs.first).norm() <= 1e-3 * mine.first.norm()
    assert len(seen) == 6


@pytest.mark.parametrize("changes", [{}, PLAIN])
def test_results_are_those_of_the_cpu(emulation: Emulation, changes: dict[str, Any]) -> None:
    check_same_results(fitted(emulated(emulation), **changes), fitted(cpu_backend(), **changes))


def test_results_depend_neither_on_the_order_of_threads_nor_on_room(emulation: Emulation) -> None:
    found = [
        state_of(fitted(emulated(emulation, order=order, slots=slots)).scene)
        for order, slots in ((0, None), (1, None), (0, 1))
    ]
    assert all(torch.equal(value, other[name]) for other in found[1:] for name, value in found[0].items())
