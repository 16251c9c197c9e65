# SPDX-License-Identifier: Apache-2.0
"""gsplat's CUDA rasteriser with this package's contract.

gsplat is imported only if there is a GPU: without one its import prints warnings and its functions fail when called.
"""

import importlib.util

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.cuda_tiles import PairBudget, tile_lists
from structgstream.kernels.raster_types import TILE_PIXELS, RasterOutput, TileSelection, tile_grid
from structgstream.kernels.reference_raster import boxes_reaching_tiles, detach_untrained, restrict_to_tiles


def cuda_reason() -> str | None:
    """Why the back-end is not available on this machine and how to get it; None if it is."""
    if not torch.cuda.is_available():
        built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
        return f"torch {torch.__version__}, {built}, sees no NVIDIA GPU; install a driver and a CUDA build of torch."
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed; install it with: pip install 'structgstream[cuda]'"
    return None


def rasterize(
    gaussians: Gaussians,
    viewport: Viewport,
    *,
    background: Tensor | None = None,
    screen_offsets: Tensor | None = None,
    tiles: TileSelection | None = None,
    onto: Tensor | None = None,
    trained: int | None = None,
    budget: PairBudget | None = None,
) -> RasterOutput:
    """See ``kernels.operations.Rasterize``.

    The screen offsets are added between gsplat's projection and its rasterisation, so that their gradient is the same
    on every back-end. ``trained`` saves no work here: the other gradients are computed and dropped. With a ``budget``
    there is no host synchronisation (``kernels.cuda_tiles``, Note [Pairs without waiting]).
    """
    from gsplat.cuda._wrapper import rasterize_to_pixels  # pyright: ignore[reportMissingImports]

    gaussians, screen_offsets = detach_untrained(gaussians, screen_offsets, trained)
    radii, means2d, depths, conics = _projected(gaussians, viewport)
    if screen_offsets is not None:
        means2d = means2d + screen_offsets[None]
    starts, ids, masks = _pair_lists(means2d, radii, depths, viewport, tiles, budget)
    image, alpha = rasterize_to_pixels(
        means2d,
        conics,
        gaussians.colors[None],
        gaussians.opacities[None],
        viewport.width,
        viewport.height,
        TILE_PIXELS,
        starts,
        ids,
        backgrounds=None if background is None else background[None],
        masks=masks,
        packed=False,
    )
    drawn = radii[0].amax(-1).float()
    if tiles is not None:
        center = means2d[0].detach()
        drawn = torch.where(boxes_reaching_tiles(center - radii[0], center + radii[0], tiles), drawn, 0.0)
    return restrict_to_tiles(image[0], alpha[0, :, :, 0], drawn, tiles, onto)


def _projected(gaussians: Gaussians, viewport: Viewport) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Radii ``[1, N, 2]`` int32, means ``[1, N, 2]``, depths ``[1, N]`` and conics ``[1, N, 3]`` on the picture."""
    from gsplat.cuda._wrapper import fully_fused_projection  # pyright: ignore[reportMissingImports]

    radii, means2d, depths, conics, _ = fully_fused_projection(
        gaussians.means,
        None,
        gaussians.quats,
        gaussians.scales,
        viewport.viewmat[None],
        viewport.K[None],
        viewport.width,
        viewport.height,
        eps2d=0.3,
        near_plane=viewport.near,
        packed=False,
        opacities=gaussians.opacities,
    )
    return radii, means2d, depths, conics


def _pair_lists(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    viewport: Viewport,
    tiles: TileSelection | None,
    budget: PairBudget | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """gsplat's arguments: start of each tile's list ``[1, rows, columns]``, rows of the Gaussians, and mask of the
    tiles to draw ``[1, rows, columns]``; with a ``budget`` there is an extra row of tiles.
    """
    masks = None if tiles is None else tiles.mask
    if budget is not None and means2d.shape[1]:
        lists = tile_lists(
            means2d[0], radii[0], depths[0], width=viewport.width, height=viewport.height, capacity=budget.capacity
        )
        torch.maximum(budget.needed, lists.needed, out=budget.needed)
        if masks is not None:
            masks = torch.cat([masks, torch.zeros_like(masks[:1])])[None]  # the row below the picture
        return lists.starts[None], lists.ids, masks
    from gsplat.cuda._wrapper import isect_offset_encode, isect_tiles  # pyright: ignore[reportMissingImports]

    rows, columns = tile_grid(viewport.width, viewport.height)
    _, pairs, ids = isect_tiles(means2d, radii, depths, TILE_PIXELS, columns, rows, packed=False, n_images=1)
    starts = isect_offset_encode(pairs, 1, columns, rows).reshape(1, rows, columns)
    return starts, ids, None if masks is None else masks[None]
