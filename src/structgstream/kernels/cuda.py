# SPDX-License-Identifier: Apache-2.0
"""gsplat's CUDA rasteriser with this package's contract.

gsplat is imported only if there is a GPU: without one its import prints warnings and its functions fail when called.
"""

import importlib.util
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.cuda_tiles import PairBudget, radii_reaching_tiles, tile_lists, tile_lists_in_kernels
from structgstream.kernels.raster_types import TILE_PIXELS, RasterOutput, TileSelection, tile_grid
from structgstream.kernels.reference_raster import (
    LOW_PASS_PIXELS,
    boxes_reaching_tiles,
    restrict_to_tiles,
    screen_low_pass,
)


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
    library: KernelLibrary | None = None,
) -> RasterOutput:
    """See ``kernels.operations.Rasterize``.

    The screen offsets are added between gsplat's projection and its rasterisation, so that their gradient is the same
    on every back-end. ``trained`` saves no work here: the other gradients are computed and dropped. With a ``budget``
    there is no host synchronisation (``kernels.cuda_tiles``, Note [Pairs without waiting]), and with a ``library`` its
    tile lists, and radii where there are tiles, are made by this package's kernels.
    """
    from gsplat.cuda._wrapper import rasterize_to_pixels  # pyright: ignore[reportMissingImports]

    gaussians, screen_offsets = _with_trained_rows(gaussians, screen_offsets, trained)
    radii, means2d, depths, conics = _projected(gaussians, viewport)
    opacities = gaussians.opacities
    if gaussians.sampling_intervals is not None:
        radii, conics, opacities = _filtered(radii, depths, conics, gaussians, viewport)
    if screen_offsets is not None:
        means2d = means2d + screen_offsets[None]
    starts, ids, masks = _pair_lists(means2d, radii, depths, viewport, tiles, budget, library)
    image, alpha = rasterize_to_pixels(
        means2d,
        conics,
        gaussians.colors[None],
        opacities[None],
        viewport.width,
        viewport.height,
        TILE_PIXELS,
        starts,
        ids,
        backgrounds=None if background is None else background[None],
        masks=masks,
        packed=False,
    )
    drawn = _drawn_radii(means2d[0].detach(), radii[0], tiles, library)
    return restrict_to_tiles(image[0], alpha[0, :, :, 0], drawn, tiles, onto)


class _FirstRows(torch.autograd.Function):
    """The identity, whose gradients are those of the first rows; a slice and a concatenation are ten times the work."""

    @staticmethod
    def forward(ctx: Any, rows: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.rows = rows
        return tuple(tensor.view_as(tensor) for tensor in tensors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        keep = torch.arange(len(gradients[0]), device=gradients[0].device) < ctx.rows
        return None, *(torch.where(keep.view(-1, *[1] * (g.ndim - 1)), g, 0.0) for g in gradients)


def _with_trained_rows(
    gaussians: Gaussians, screen_offsets: Tensor | None, trained: int | None
) -> tuple[Gaussians, Tensor | None]:
    """The arguments, of which only the first ``trained`` rows get gradients."""
    if trained is None or trained >= len(gaussians):
        return gaussians, screen_offsets
    names = ["means", "quats", "scales", "opacities", "colors"]
    values = [getattr(gaussians, name) for name in names] + ([] if screen_offsets is None else [screen_offsets])
    found = _FirstRows.apply(trained, *values)
    return (
        replace(gaussians, **dict(zip(names, found, strict=False))),  # type: ignore[arg-type]
        None if screen_offsets is None else found[-1],  # type: ignore[index]
    )


def _drawn_radii(means2d: Tensor, radii: Tensor, tiles: TileSelection | None, library: KernelLibrary | None) -> Tensor:
    """Radii ``[N]`` in pixels, 0 for Gaussians that are not drawn."""
    if tiles is None:
        return radii.amax(-1).float()
    if library is not None:
        return radii_reaching_tiles(library, means2d, radii, tiles)
    reaching = boxes_reaching_tiles(means2d - radii, means2d + radii, tiles)
    return torch.where(reaching, radii.amax(-1).float(), 0.0)


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
        eps2d=LOW_PASS_PIXELS,
        near_plane=viewport.near,
        packed=False,
        opacities=gaussians.opacities,
    )
    return radii, means2d, depths, conics


def _filtered(
    radii: Tensor, depths: Tensor, conics: Tensor, gaussians: Gaussians, viewport: Viewport
) -> tuple[Tensor, Tensor, Tensor]:
    """Radii, conics and opacities ``[N]`` with the low-pass of the training pictures in place of gsplat's.

    What gsplat's own low-pass leaves outside of the picture is not drawn: of a picture that is larger than the training
    pictures a few pixels at the border lack it.
    """
    assert gaussians.sampling_intervals is not None
    trained, total = screen_low_pass(
        gaussians.sampling_intervals, depths[0].detach().clamp(min=viewport.near), viewport.K
    )
    a, b, c = conics[0].unbind(1)
    determinant = a * c - b * b
    xx, xy, yy = c / determinant - LOW_PASS_PIXELS, -b / determinant, a / determinant - LOW_PASS_PIXELS
    square, size = (xx * yy - xy * xy).detach().clamp(min=0.0), (xx + yy).detach()
    before, after = (square + variance * (size + variance) for variance in (trained, total))
    opacities = gaussians.opacities * (before / after).nan_to_num().clamp(0.0, 1.0).sqrt()
    xx, yy = xx + total, yy + total
    conics = torch.stack([yy, -xy, xx], dim=1) / (xx * yy - xy * xy)[:, None]
    reach = 2.0 * (255.0 * opacities.detach()).clamp(min=1.0).log()
    extents = (reach[:, None] * torch.stack([xx, yy], dim=1).detach()).clamp(min=0.0).sqrt().ceil()
    drawn = (radii[0] > 0).all(1, keepdim=True) & torch.isfinite(extents)
    return torch.where(drawn, extents.to(radii.dtype), 0)[None], conics[None], opacities


def _pair_lists(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    viewport: Viewport,
    tiles: TileSelection | None,
    budget: PairBudget | None,
    library: KernelLibrary | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """gsplat's arguments: start of each tile's list ``[1, rows, columns]``, rows of the Gaussians, and mask of the
    tiles to draw ``[1, rows, columns]``; with a ``budget`` there is an extra row of tiles.
    """
    masks = None if tiles is None else tiles.mask
    if budget is not None and means2d.shape[1]:
        listed = tile_lists if library is None else partial(tile_lists_in_kernels, library)
        lists = listed(
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
