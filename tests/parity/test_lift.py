# SPDX-License-Identifier: Apache-2.0
"""Flow lifted to displacements: each back-end against the oracle."""

from collections.abc import Callable, Iterable
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from structgstream.kernels import cpu_motion, cuda, reference_motion
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import Lifted, Neighbors, ViewFlows
from tests.parity.conftest import check_any_threads, in_both_orders
from tests.support.backends import needs_native


def scenery(
    seed: int, *, movers: int = 40, views: int = 5, targets: int = 30, count: int = 7, speed: float = 1.0
) -> dict[str, torch.Tensor]:
    """Cameras on a ring that look at movers around the origin, each of which moves by the same displacement, 5 pixels
    times ``speed``."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    centers = 0.3 * draw(movers, 3)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    for v in range(views):
        angle = torch.tensor(0.4 * v)
        c, s = angle.cos(), angle.sin()
        viewmats[v, :3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        viewmats[v, 2, 3] = 2.0
    Ks = torch.tensor([[300.0, 0, 160], [0, 310.0, 120], [0, 0, 1]], dtype=torch.float64).repeat(views, 1, 1)
    near = torch.full((views,), 1.5, dtype=torch.float64)  # some movers lie before it
    motion = speed * torch.tensor([0.03, -0.02, 0.01], dtype=torch.float64)
    jacobians = reference_motion.projection_jacobians(centers, viewmats, Ks, near)
    flows = jacobians @ motion + (0.3 + 0.05 * (speed - 1.0) * 5.0) * draw(views, movers, 2)
    weights = torch.rand(views, movers, generator=generator, dtype=torch.float64) * 5
    weights[weights < 1.0] = 0.0
    flows[0] += 30.0  # a view whose flow is wrong
    return {
        "centers": centers,
        "weights": weights,
        "flows": flows,
        "viewmats": viewmats,
        "Ks": Ks,
        "near": near,
        "neighbours": torch.randint(movers, (targets, count), generator=generator),
        "affinities": torch.rand(targets, count, generator=generator, dtype=torch.float64),
        "priors": 0.05 * draw(targets, 3),
    }


def single(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: t if t.dtype == torch.int64 else t.float() for name, t in tensors.items()}


def lifted(module, given: dict[str, torch.Tensor]) -> Lifted:
    seen = ViewFlows(*(given[name] for name in ViewFlows._fields))
    around = Neighbors(given["neighbours"], given["affinities"])
    return module.lift(given["centers"], seen, around, given["priors"], share=0.4)


def compare(found: Lifted, given: dict[str, torch.Tensor]) -> None:
    oracle = lifted(reference_motion, given)
    # Rounds feed on each other, so single precision shows in the fifth digit.
    torch.testing.assert_close(found.displacements.double(), oracle.displacements, atol=2e-5, rtol=1e-3)
    near_the_edge = (found.inlier_share.double() - oracle.inlier_share).abs() > 1e-3
    assert near_the_edge.float().mean() <= 0.1  # a term may lie at the bound exactly
    assert (found.agreeing_views == oracle.agreeing_views).float().mean() >= 0.9


@pytest.mark.parametrize(("seed", "speed"), [(0, 1.0), (1, 1.0), (2, 8.0)])
def test_cpu_finds_what_the_oracle_finds(isa: int, seed: int, speed: float) -> None:
    given = scenery(seed, speed=speed)
    compare(lifted(cpu_motion, single(given)), given)


@pytest.mark.parametrize(("seed", "speed"), [(0, 1.0), (2, 8.0)])
def test_a_gpu_finds_what_the_oracle_finds(emulation: Callable[[int], KernelLibrary], seed: int, speed: float) -> None:
    given = scenery(seed, speed=speed)

    def run(library: KernelLibrary) -> Iterable[torch.Tensor]:
        return vars(lifted(SimpleNamespace(lift=partial(cuda.lift, library)), single(given))).values()

    compare(Lifted(*in_both_orders(emulation, run)), given)


@needs_native
def test_cpu_gives_the_same_bits_with_any_number_of_threads() -> None:
    given = single(scenery(3, targets=200))
    check_any_threads(lambda: vars(lifted(cpu_motion, given)).values())


@needs_native
def test_cpu_without_evidence_keeps_the_prior() -> None:
    given = single(scenery(2))
    given["weights"] = torch.zeros_like(given["weights"])
    found = lifted(cpu_motion, given)
    assert torch.equal(found.displacements, given["priors"])
    assert not found.inlier_share.any()
    assert not found.agreeing_views.any()
