# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians a tile draws, front to back, without asking the GPU how many there are.

Note [Pairs without waiting]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~
gsplat's rasteriser reads the number of (Gaussian, tile) pairs on the host before it makes the lists: once a picture the
host waits for all that is queued. Here the lists have a fixed capacity. Unused places go to a row of tiles below the
picture, which has no pixels; of pairs beyond the capacity the furthest are lost, and ``PairBudget`` remembers how many
there should have been. Whoever sets a budget asks once, at the end of its work, and does the work again with a larger
one if it was short: lists do not depend on the capacity, as long as it suffices.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from structgstream.kernels.raster_types import TILE_PIXELS, tile_grid

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PairBudget:
    """Room for the pairs of a picture, and the most that one has needed (Note [Pairs without waiting]).

    Args:
        capacity: places.
        needed: ``[]`` int64, on the device; grows in place.
    """

    capacity: int
    needed: Tensor

    @classmethod
    def of(cls, capacity: int, device: torch.device) -> "PairBudget":
        """A budget that nothing has needed yet."""
        return cls(capacity, torch.zeros((), dtype=torch.int64, device=device))

    def shortage(self) -> int:
        """Places that were missing in the worst picture, 0 when all had room. The host waits for the device here."""
        return max(0, int(self.needed) - self.capacity)


Result = TypeVar("Result")


def run_with_pair_budget(work: Callable[[PairBudget], Result], *, capacity: int, device: torch.device) -> Result:
    """What ``work`` gives within a budget; done again with more room until nothing was short."""
    while True:
        budget = PairBudget.of(capacity, device)
        result = work(budget)
        shortage = budget.shortage()
        if shortage == 0:
            return result
        _log.info("Pictures needed room for %d pairs more than %d; the work is done again.", shortage, capacity)
        capacity += 2 * shortage


class TileLists(NamedTuple):
    """Lists of Gaussians by tile, as gsplat reads them.

    Args:
        starts: ``[rows + 1, columns]`` int32, where each tile's list starts; the last row is not of the picture.
        ids: ``[capacity]`` int32, rows of the Gaussians.
        needed: ``[]`` int64, pairs that there are.
    """

    starts: Tensor
    ids: Tensor
    needed: Tensor


def tile_lists(means2d: Tensor, radii: Tensor, depths: Tensor, *, width: int, height: int, capacity: int) -> TileLists:
    """Lists of at most ``capacity`` pairs, in each tile by depth, equal depths by row.

    Args:
        means2d: ``[N, 2]`` pixels, ``N`` > 0.
        radii: ``[N, 2]`` int32 pixels, 0 where a Gaussian is not drawn; its other values may be anything.
        depths: ``[N]``.
        width: of the picture, pixels.
        height: of the picture, pixels.
        capacity: places, see Note [Pairs without waiting].
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
        # Spread out, so that no tile below the picture has a long list.
        tile = torch.where(places < needed, tile, rows * columns + places % columns)
        short = torch.int16 if (rows + 1) * columns < torch.iinfo(torch.int16).max else torch.int32
        sorted_tiles, by_tile = tile.to(short).sort(stable=True)  # Places are in order of depth, and stay so in a tile.
        every = torch.arange((rows + 1) * columns, dtype=short, device=means2d.device)
        starts = torch.searchsorted(sorted_tiles, every, out_int32=True)
    return TileLists(starts.reshape(rows + 1, columns), order[owners[by_tile]].to(torch.int32), needed)
