# SPDX-License-Identifier: Apache-2.0
"""Depth-sorted lists of the Gaussians of each tile, with a fixed capacity and no host synchronisation.

Note [Pairs without waiting]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~
gsplat's rasteriser reads the number of (Gaussian, tile) pairs on the host before it makes the lists, which synchronises
host and device once per picture. Here the lists have a fixed capacity. Unused places go to a row of tiles below the
picture, which has no pixels; of pairs beyond the capacity the farthest are dropped, and ``PairBudget`` records how many
were needed. The caller checks the budget once, at the end of its work, and repeats the work with a larger budget if it
was too small. With sufficient capacity the lists do not depend on it.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import TILE_PIXELS, TileSelection, tile_grid

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PairBudget:
    """Capacity of a picture's lists, and the largest number of pairs needed (Note [Pairs without waiting]).

    Args:
        capacity: pairs.
        needed: ``[]`` int64 on the device, the maximum over pictures; updated in place.
    """

    capacity: int
    needed: Tensor

    @classmethod
    def of(cls, capacity: int, device: torch.device) -> "PairBudget":
        """A budget with ``needed`` 0."""
        return cls(capacity, torch.zeros((), dtype=torch.int64, device=device))

    def shortage(self) -> int:
        """Pairs beyond the capacity in the worst picture, 0 if none. Synchronises host and device."""
        return max(0, int(self.needed) - self.capacity)


Result = TypeVar("Result")


def run_with_pair_budget(work: Callable[[PairBudget], Result], *, capacity: int, device: torch.device) -> Result:
    """The result of ``work``, repeated with a larger budget until the capacity suffices."""
    while True:
        budget = PairBudget.of(capacity, device)
        result = work(budget)
        shortage = budget.shortage()
        if shortage == 0:
            return result
        _log.info("Pictures needed %d pairs more than the capacity of %d; the work is repeated.", shortage, capacity)
        capacity += 2 * shortage


class TileLists(NamedTuple):
    """Lists of Gaussians by tile, as gsplat reads them.

    Args:
        starts: ``[rows + 1, columns]`` int32, start of each tile's list; the last row lies below the picture.
        ids: ``[capacity]`` int32, rows of the Gaussians.
        needed: ``[]`` int64, number of pairs.
    """

    starts: Tensor
    ids: Tensor
    needed: Tensor


def tile_lists(means2d: Tensor, radii: Tensor, depths: Tensor, *, width: int, height: int, capacity: int) -> TileLists:
    """Lists of at most ``capacity`` pairs, sorted in each tile by depth, then by row.

    Args:
        means2d: ``[N, 2]`` pixels, ``N`` > 0.
        radii: ``[N, 2]`` int32 pixels, 0 for a Gaussian that is not drawn, whose other values are ignored.
        depths: ``[N]``.
        width: of the picture, pixels.
        height: of the picture, pixels.
        capacity: pairs, see Note [Pairs without waiting].
    """
    rows, columns = tile_grid(width, height)
    with torch.no_grad():
        drawn = (radii > 0).all(1)
        order = torch.where(drawn, depths, torch.inf).argsort(stable=True)
        drawn, centers, reach = drawn[order], means2d[order], radii[order]
        limits = torch.stack([torch.full_like(order[:1], size) for size in (columns, rows)], dim=1)
        low, high = (
            torch.where(drawn[:, None], edge, 0.0).clamp(min=0.0).long().minimum(limits)
            for edge in (
                (centers / TILE_PIXELS - reach / TILE_PIXELS).floor(),
                (centers / TILE_PIXELS + reach / TILE_PIXELS).ceil(),
            )
        )
        across, down = (high - low).unbind(1)
        counts = across * down
        ends = counts.cumsum(0)
        needed = ends[-1]
        places = torch.arange(capacity, device=means2d.device)
        owners = torch.searchsorted(ends, places, right=True).clamp(max=ends.shape[0] - 1)
        nth = places - (ends - counts)[owners]
        wide = across.clamp(min=1)[owners]
        tile = (low[owners, 1] + nth // wide) * columns + low[owners, 0] + nth % wide
        # Unused places are spread over the tiles below the picture, so that none has a long list.
        tile = torch.where(places < needed, tile, rows * columns + places % columns)
        short = torch.int16 if (rows + 1) * columns < torch.iinfo(torch.int16).max else torch.int32
        sorted_tiles, by_tile = tile.to(short).sort(stable=True)  # A stable sort preserves depth order in a tile.
        every = torch.arange((rows + 1) * columns, dtype=short, device=means2d.device)
        starts = torch.searchsorted(sorted_tiles, every, out_int32=True)
    return TileLists(starts.reshape(rows + 1, columns), order[owners[by_tile]].to(torch.int32), needed)


def radii_reaching_tiles(library: KernelLibrary, means2d: Tensor, radii: Tensor, tiles: TileSelection) -> Tensor:
    """``[N]`` float32 pixels: the larger of ``radii`` ``[N, 2]`` int32, 0 for a Gaussian that reaches none of ``tiles``
    (``reference_raster.boxes_reaching_tiles``)."""
    means2d, radii, mask = means2d.detach().contiguous(), radii.contiguous(), tiles.mask.contiguous()
    library.check_devices(means2d, radii, mask)
    drawn = torch.empty_like(means2d[:, 0], memory_format=torch.contiguous_format)
    library.call(
        "sgs_cuda_tile_reached",
        *(means2d, radii, len(radii), mask, tiles.width, tiles.height, drawn),
        device=means2d.device,
    )
    return drawn


def tile_lists_in_kernels(
    library: KernelLibrary,
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    *,
    width: int,
    height: int,
    capacity: int,
) -> TileLists:
    """As :func:`tile_lists`, float32, with a kernel for each step between the sorts: 7 operations, not 45."""
    rows, columns = tile_grid(width, height)
    count, device = len(depths), means2d.device
    means2d, radii, depths = (value.detach().contiguous() for value in (means2d, radii, depths))
    library.check_devices(means2d, radii, depths)
    assert (means2d.dtype, radii.dtype, depths.dtype) == (torch.float32, torch.int32, torch.float32)
    keys, pairs = torch.empty_like(depths), torch.empty(count, dtype=torch.int64, device=device)
    tiles, ids, sorted_ids = (torch.empty(capacity, dtype=torch.int32, device=device) for _ in range(3))
    starts = torch.empty(rows + 1, columns, dtype=torch.int32, device=device)
    library.call("sgs_cuda_tile_depths", radii, depths, count, keys, device=device)
    order = keys.argsort(stable=True)
    library.call("sgs_cuda_tile_counts", means2d, radii, order, count, columns, rows, pairs, device=device)
    ends = pairs.cumsum(0)
    library.call(
        "sgs_cuda_tile_fill",
        *(means2d, radii, order, ends, count, columns, rows, capacity, tiles, ids),
        device=device,
    )
    sorted_tiles, by_tile = tiles.sort(stable=True)  # A stable sort preserves depth order in a tile.
    library.call(
        "sgs_cuda_tile_starts",
        *(sorted_tiles, by_tile, ids, capacity, columns, rows, starts, sorted_ids),
        device=device,
    )
    return TileLists(starts, sorted_ids, ends[-1])
