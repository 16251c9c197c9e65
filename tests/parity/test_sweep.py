# SPDX-License-Identifier: Apache-2.0
"""The sweep along rays: the C++ against the oracle."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch

from structgstream.kernels import cpu_motion, cuda, reference_motion
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import SweepView, Swept
from tests.parity.conftest import check_any_threads, in_both_orders
from tests.support.backends import needs_native
from tests.support.rigs import arc_rig


def views(seed: int, dtype: torch.dtype) -> list[SweepView]:
    """Random pictures in which half of the pixels are missing, and a few show nothing at all."""
    generator = torch.Generator().manual_seed(seed)
    rig, found = arc_rig(5, width=24, height=20), []
    for name in rig.training:
        camera = rig[name]
        depths = 2.0 + 2.0 * torch.rand(20, 24, generator=generator)
        depths[torch.rand(20, 24, generator=generator) < 0.1] = torch.inf
        found.append(
            SweepView(
                colors=torch.rand(20, 24, 3, generator=generator).to(dtype),
                missing=(torch.rand(20, 24, generator=generator) * 1.4 - 0.2).clamp(0, 1).to(dtype),
                depths=depths.to(dtype),
                viewmat=camera.viewmat.to(dtype),
                K=camera.K.to(dtype),
                near=1.0,
            )
        )
    return found


def rays(seed: int, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.stack(
        [torch.randint(24, (150,), generator=generator), torch.randint(20, (150,), generator=generator)], 1
    )
    return pixels, (1.5 + 3 * torch.rand(150, generator=generator)).to(dtype)


RULES = {"planes": 17, "min_supports": 2, "max_contradictions": 0.34}


@pytest.fixture(
    params=[
        pytest.param("cpu", marks=needs_native),
        "emulated",
        pytest.param("cuda", marks=pytest.mark.needs_cuda),
    ]
)
def sweep(request: pytest.FixtureRequest, kernels_on: Callable[[str], KernelLibrary]) -> Callable[..., Swept]:
    """A sweep in float32, of the C++, of the CUDA functions on a processor, or of a GPU; on the processor's tensors."""
    if request.param == "cpu":
        return cpu_motion.sweep
    if request.param == "emulated":
        return partial(cuda.sweep, kernels_on("cpu"))
    library = kernels_on("cuda")

    def there(given: list[SweepView], view_index: int, *tensors: torch.Tensor, **rules: Any) -> Swept:
        every: list[dict[str, Any]] = [vars(view) for view in given]
        moved = [SweepView(**{k: v.cuda() if k != "near" else v for k, v in view.items()}) for view in every]
        found = cuda.sweep(library, moved, view_index, *(t.cuda() for t in tensors), **rules)
        return Swept(found.depths.cpu(), found.costs.cpu())

    return there


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_finds_what_the_oracle_finds(sweep: Callable[..., Swept], seed: int) -> None:
    found = sweep(views(seed, torch.float32), 1, *rays(seed, torch.float32), **RULES)
    oracle = reference_motion.sweep(views(seed, torch.float64), 1, *rays(seed, torch.float64), **RULES)
    assert 0 < found.costs.isfinite().sum() < 150, "both kinds of ray"
    # A point may fall on the border of two pixels, where precision decides.
    close = torch.isclose(found.costs.double(), oracle.costs, atol=1e-4) | (found.costs.isinf() & oracle.costs.isinf())
    assert close.float().mean() > 0.97
    same = close & found.costs.isfinite()
    assert torch.isclose(found.depths.double(), oracle.depths, rtol=1e-4)[same].float().mean() > 0.97


@needs_native
def test_cpu_gives_the_same_bits_with_any_number_of_threads() -> None:
    given = views(3, torch.float32), 0, *rays(3, torch.float32)
    check_any_threads(lambda: vars(cpu_motion.sweep(*given, **RULES)).values(), (1, 3))


def test_the_cuda_elements_need_no_order(emulation: Callable[[int], KernelLibrary]) -> None:
    given = views(4, torch.float32), 2, *rays(4, torch.float32)
    in_both_orders(emulation, lambda library: vars(cuda.sweep(library, *given, **RULES)).values())
