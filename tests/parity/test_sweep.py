# SPDX-License-Identifier: Apache-2.0
"""The sweep along rays: the C++ against the oracle."""

import pytest
import torch

from rigs import arc_rig
from structgstream.kernels import cpu_sweep, reference_sweep
from structgstream.kernels._load import native_reason
from structgstream.kernels.motion_types import SweepView

needs_native = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


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


RULES = {"planes": 17, "least_supports": 2, "most_contradictions": 0.34}


@needs_native
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cpu_finds_what_the_oracle_finds(seed: int) -> None:
    found = cpu_sweep.sweep(views(seed, torch.float32), 1, *rays(seed, torch.float32), **RULES)
    oracle = reference_sweep.sweep(views(seed, torch.float64), 1, *rays(seed, torch.float64), **RULES)
    assert 0 < found.costs.isfinite().sum() < 150, "both kinds of ray"
    # A point may fall on the border of two pixels, where precision decides.
    close = torch.isclose(found.costs.double(), oracle.costs, atol=1e-4) | (found.costs.isinf() & oracle.costs.isinf())
    assert close.float().mean() > 0.97
    same = close & found.costs.isfinite()
    assert torch.isclose(found.depths.double(), oracle.depths, rtol=1e-4)[same].float().mean() > 0.97


@needs_native
def test_cpu_gives_the_same_bits_with_any_number_of_threads() -> None:
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(cpu_sweep.sweep(views(3, torch.float32), 0, *rays(3, torch.float32), **RULES))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(results[0].depths, results[1].depths)
    assert torch.equal(results[0].costs, results[1].costs)
