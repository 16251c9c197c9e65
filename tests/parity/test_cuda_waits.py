# SPDX-License-Identifier: Apache-2.0
"""Without a GPU: no operation of the cuda back-end's torch parts is one for which a host would wait.

torch says so itself only on a GPU (``torch.cuda.set_sync_debug_mode``, as the tests that need one do). Here every
operation that reaches the dispatcher is looked at: those whose result, or whose result's shape, a host must know.
"""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from structgstream.kernels import cuda, cuda_anchors, reference_anchors
from structgstream.kernels.cuda_tiles import tile_lists
from structgstream.kernels.reference_raster import boxes_reaching_tiles
from structgstream.kernels.values import Anchors, HeadWeights, MLPWeights, TileSelection, tile_grid
from tests.support.splats import viewport_of

VIEW = viewport_of(torch.eye(4), torch.tensor([[30.0, 0, 20], [0, 30, 20], [0, 0, 1]]), width=40, height=40, near=0.1)
WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "equal", "is_nonzero", "_unique2", "unique_dim")


class NoWaiting(TorchDispatchMode):
    """Fails at an operation whose result, or its shape, the host must know."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func._schema.name.removeprefix("aten::")
        indices = args[1] if name in ("index", "index_put", "index_put_", "_index_put_impl_") else ()
        by_mask = any(isinstance(index, Tensor) and index.dtype in (torch.bool, torch.uint8) for index in indices)
        counted = name == "repeat_interleave" and kwargs is not None and kwargs.get("output_size") is None
        if name in WAITS or by_mask or counted:
            raise RuntimeError(f"a host would wait for {name}")
        return func(*args, **(kwargs or {}))


def anchors(m: int = 30, k: int = 3, d: int = 5) -> tuple[list[Tensor], MLPWeights]:
    values = [torch.randn(m, 3) + torch.tensor([0.0, 0.0, 4.0]), torch.randn(m, 3) - 2.0, torch.randn(m, 3) - 2.0]
    values += [torch.randn(m, k, 3), torch.randn(m, d)]
    heads = [[torch.randn(8, d + 4), torch.randn(8), torch.randn(n * k, 8), torch.randn(n * k)] for n in (1, 3, 7)]
    for value in [*values, *(weight for head in heads for weight in head)]:
        value.requires_grad_()
    return values, MLPWeights(*(HeadWeights(*head) for head in heads))


@pytest.mark.parametrize("tiled", [False, True])
def test_seeing_and_dressing_anchors(tiled: bool) -> None:
    values, mlps = anchors()
    tiles = TileSelection(torch.rand(tile_grid(40, 40)) < 0.5, 40, 40) if tiled else None
    with NoWaiting():
        g = cuda_anchors.generate_all_in_torch(Anchors(*values), mlps, VIEW, distance_input=True, tiles=tiles).gaussians
        total = g.means.sum() + g.quats.sum() + g.scales.sum() + g.opacities.sum() + g.colors.sum()
        torch.autograd.grad(total, [*values, *(weight for head in mlps for weight in head)])


def test_tile_lists_and_masks_of_pixels() -> None:
    means2d, radii = torch.rand(50, 2) * 60, torch.randint(0, 9, (50, 2), dtype=torch.int32)
    depths, tiles = torch.rand(50), TileSelection(torch.rand(tile_grid(60, 60)) < 0.5, 60, 60)
    low, high = torch.rand(50, 2) * 30, torch.rand(50, 2) * 60
    with NoWaiting():
        tile_lists(means2d, radii, depths, width=60, height=60, capacity=900)
        tiles.pixels()
        boxes_reaching_tiles(low, high, tiles)


def test_the_optimiser() -> None:
    values = [torch.randn(20, 3) for _ in range(2)] + [torch.zeros(20, 3) for _ in range(2)]
    with NoWaiting():
        cuda.adam_step(*values, lr=0.1, step=3, betas=(0.9, 0.999), eps=1e-15)


def test_what_the_other_back_ends_do_is_caught() -> None:
    values, mlps = anchors()
    with NoWaiting(), pytest.raises(RuntimeError, match="nonzero"):
        reference_anchors.generate_structured(Anchors(*values), mlps, VIEW, distance_input=True)
    with NoWaiting(), pytest.raises(RuntimeError, match="index"):
        torch.ones(3)[torch.tensor([True, False, True])]
    with NoWaiting(), pytest.raises(RuntimeError, match="_local_scalar_dense"):
        float(torch.ones(()))
