# SPDX-License-Identifier: Apache-2.0
"""gsplat's CUDA rasteriser behind this package's contract.

gsplat is imported only when a GPU is there: without one its import prints warnings and its functions fail late.
"""

import importlib.util

import torch
from torch import Tensor

from structgstream.kernels.cuda_tiles import PairBudget, tile_lists
from structgstream.kernels.raster_types import TILE_PIXELS, RasterOutput, pixels_of_tiles, tiles_of


def cuda_reason() -> str | None:
    """Why the back-end is not available on this machine, with the way to get it; None when it is."""
    if not torch.cuda.is_available():
        built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
        return f"torch {torch.__version__}, {built}, sees no NVIDIA GPU; install a driver and a CUDA build of torch."
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed; install it with: pip install 'structgstream[cuda]'"
    return None


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    *,
    width: int,
    height: int,
    near: float,
    background: Tensor | None = None,
    screen_offsets: Tensor | None = None,
    tiles: Tensor | None = None,
    onto: Tensor | None = None,
    trained: int | None = None,
    budget: PairBudget | None = None,
) -> RasterOutput:
    """The contract of ``kernels.reference_raster.rasterize`` on a GPU.

    The screen offsets are added between gsplat's projection and its rasterisation, so that their gradient means the
    same on every back-end. With ``tiles``, ``radii`` also counts Gaussians that reach other tiles only, and ``trained``
    saves nothing here: the gradients of the rest are computed and not used. With a ``budget`` the host does not wait
    (``kernels.cuda_tiles``, Note [Pairs without waiting]).
    """
    if trained is not None:
        means, quats, scales, opacities, colors = (
            torch.cat([tensor[:trained], tensor[trained:].detach()])
            for tensor in (means, quats, scales, opacities, colors)
        )
        if screen_offsets is not None:
            screen_offsets = torch.cat([screen_offsets[:trained], screen_offsets[trained:].detach()])
    from gsplat.cuda._wrapper import (  # pyright: ignore[reportMissingImports]
        fully_fused_projection,
        isect_offset_encode,
        isect_tiles,
        rasterize_to_pixels,
    )

    radii, means2d, depths, conics, _ = fully_fused_projection(
        means,
        None,
        quats,
        scales,
        viewmat[None],
        K[None],
        width,
        height,
        eps2d=0.3,
        near_plane=near,
        packed=False,
        opacities=opacities,
    )  # [1, N, 2], [1, N, 2], [1, N], [1, N, 3]
    if screen_offsets is not None:
        means2d = means2d + screen_offsets[None]
    rows, columns = tiles_of(width, height)
    masks = tiles
    if budget is None or not means.shape[0]:
        _, pair_ids, flat_ids = isect_tiles(
            means2d, radii, depths, TILE_PIXELS, columns, rows, packed=False, n_images=1
        )
        tile_starts = isect_offset_encode(pair_ids, 1, columns, rows).reshape(1, rows, columns)
    else:
        lists = tile_lists(means2d[0], radii[0], depths[0], width=width, height=height, capacity=budget.capacity)
        torch.maximum(budget.needed, lists.needed, out=budget.needed)
        tile_starts, flat_ids = lists.starts[None], lists.ids
        if masks is not None:
            masks = torch.cat([masks, torch.zeros_like(masks[:1])])  # the row below the picture
    image, alpha = rasterize_to_pixels(
        means2d,
        conics,
        colors[None],
        opacities[None],
        width,
        height,
        TILE_PIXELS,
        tile_starts,
        flat_ids,
        backgrounds=None if background is None else background[None],
        masks=None if masks is None else masks[None],
        packed=False,
    )
    drawn = radii[0].amax(-1).float()
    if tiles is None:
        return RasterOutput(image=image[0], alpha=alpha[0, :, :, 0], radii=drawn)
    inside = pixels_of_tiles(tiles, width, height)
    return RasterOutput(
        image=torch.where(inside[..., None], image[0], torch.zeros_like(image[0]) if onto is None else onto),
        alpha=torch.where(inside, alpha[0, :, :, 0], 0.0),
        radii=drawn,
    )
