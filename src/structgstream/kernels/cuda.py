# SPDX-License-Identifier: Apache-2.0
"""Operations of the cuda back-end: gsplat's rasteriser, this package's kernels of losses and sweeps, torch's Adam.

gsplat is imported only if there is a GPU: without one its import prints warnings and its functions fail when called.
"""

import ctypes
import importlib.util
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.cpu_losses import Comparison
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.cuda_tiles import PairBudget, radii_reaching_tiles, tile_lists, tile_lists_in_kernels
from structgstream.kernels.native import constant, members
from structgstream.kernels.reference_raster import (
    LOW_PASS_PIXELS,
    boxes_reaching_tiles,
    restrict_to_tiles,
    screen_low_pass,
)
from structgstream.kernels.values import (
    TILE_PIXELS,
    Lifted,
    Neighbors,
    RasterOutput,
    SweepView,
    Swept,
    TileSelection,
    ViewFlows,
    tile_grid,
)


def cuda_reason(*, needs_gsplat: bool = True) -> str | None:
    """Why the back-end is not available on this machine and how to get it; None if it is."""
    if not torch.cuda.is_available():
        built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
        return f"torch {torch.__version__}, {built}, sees no NVIDIA GPU; install a driver and a CUDA build of torch."
    if needs_gsplat and importlib.util.find_spec("gsplat") is None:
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
    """See ``reference_raster.rasterize``.

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

    Gaussians that are outside the picture with gsplat's own low-pass are not drawn. They are missing in a few pixels at
    the border of a picture that is larger than the training pictures.
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


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, library: KernelLibrary, image: Tensor, comparison: Comparison) -> tuple[Tensor, Tensor]:
        rows, columns = tile_grid(image.shape[1], image.shape[0])
        adjoints = image.new_empty(3, *image.shape) if ctx.needs_input_grad[1] else None
        sums, means = image.new_empty(2, rows * columns), image.new_empty(2)
        library.call("sgs_cuda_l1_ssim", *comparison.arguments(image), adjoints, sums, means, device=image.device)
        ctx.library, ctx.comparison = library, comparison
        ctx.save_for_backward(image, adjoints)
        return means[0], means[1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, None]:
        to_l1, to_ssim = (gradient.contiguous() for gradient in gradients)
        image, adjoints = ctx.saved_tensors
        gradient = torch.empty_like(image)
        ctx.library.call(
            "sgs_cuda_l1_ssim_backward",
            *(*ctx.comparison.arguments(image), adjoints, to_l1, to_ssim, gradient),
            device=image.device,
        )
        return None, gradient, None


def l1_ssim(
    library: KernelLibrary,
    image: Tensor,
    target: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: TileSelection | None = None,
) -> tuple[Tensor, Tensor]:
    """See ``reference_losses.l1_ssim``; float32, without host synchronisation. Results repeat bit for bit.

    Raises:
        BackendError: a precision, layout, size or device that the kernels do not support.
    """
    comparison = Comparison.of(image, target, gains, biases, tiles)
    mask = None if tiles is None else tiles.mask
    library.check_devices(image, target, gains, biases, mask)
    return _L1SSIM.apply(library, image.contiguous(), comparison)  # type: ignore[return-value]


class _View(ctypes.Structure):
    """``sgs_cuda_sweep_view`` of csrc/cuda/sweep.h."""

    _fields_ = (
        *members(ctypes.c_void_p, "colors missing depths viewmat K"),
        ("near_plane", ctypes.c_float),
        *members(ctypes.c_int, "width height"),
    )


def sweep(
    library: KernelLibrary,
    views: Sequence[SweepView],
    view_index: int,
    pixels: Tensor,
    farthest: Tensor,
    *,
    planes: int,
    min_supports: int,
    max_contradictions: float,
) -> Swept:
    """See ``reference_motion.sweep``; float32. Results repeat bit for bit."""
    assert len(pixels) == len(farthest), (pixels.shape, farthest.shape)
    inputs = [[t.detach().float().contiguous() for t in (v.colors, v.missing, v.depths, v.viewmat, v.K)] for v in views]
    given = (_View * len(views))()
    for slot, view, tensors in zip(given, views, inputs, strict=True):
        library.check_devices(*tensors)
        slot.height, slot.width = view.missing.shape
        assert view.colors.shape == (slot.height, slot.width, 3), view.colors.shape
        assert view.depths.shape == view.missing.shape, view.depths.shape
        slot.colors, slot.missing, slot.depths, slot.viewmat, slot.K = library.addresses(*tensors)
        slot.near_plane = view.near
    pixels, farthest = pixels.to(torch.int64).contiguous(), farthest.float().contiguous()
    library.check_devices(pixels, farthest)
    votes = farthest.new_zeros(3, len(pixels), planes)
    found = Swept(torch.empty_like(farthest), torch.empty_like(farthest))
    library.call(
        "sgs_cuda_sweep",
        *(ctypes.addressof(given), len(views), view_index, pixels, farthest, len(pixels)),
        *(planes, min_supports, max_contradictions, votes, found.depths, found.costs),
        device=farthest.device,
    )
    return found


class _Lift(ctypes.Structure):
    """``FlowLift`` of csrc/cpu/lift.h."""

    _fields_ = (
        *members(ctypes.c_void_p, "centers weights flows viewmats Ks near neighbours affinities priors"),
        *members(ctypes.c_int64, "movers targets"),
        *members(ctypes.c_int, "views neighbour_count"),
        ("share", ctypes.c_float),
        *members(ctypes.c_void_p, "displacements inlier_share agreeing_views"),
    )


def lift(
    library: KernelLibrary, centers: Tensor, seen: ViewFlows, neighbors: Neighbors, priors: Tensor, *, share: float
) -> Lifted:
    """See ``reference_motion.lift``; float32. Results repeat bit for bit."""
    (views, dynamic), (targets, count) = seen.weights.shape, neighbors.rows.shape
    assert centers.shape == (dynamic, 3), centers.shape
    assert seen.flows.shape == (views, dynamic, 2), seen.flows.shape
    assert priors.shape == (targets, 3), priors.shape
    tensors = [constant(centers), *map(constant, seen), neighbors.rows.to(torch.int64).contiguous()]
    tensors += [constant(neighbors.affinities), constant(priors)]
    found = Lifted(
        torch.empty_like(tensors[-1]),
        torch.empty(targets, device=priors.device),
        torch.empty(targets, dtype=torch.int64, device=priors.device),
    )
    results = found.displacements, found.inlier_share, found.agreeing_views
    library.check_devices(*tensors, *results)
    at = library.addresses
    given = _Lift(*at(*tensors), dynamic, targets, views, count, share, *at(*results))
    library.call("sgs_cuda_lift", ctypes.addressof(given), device=priors.device)
    return found


def adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float | Tensor,
    step: int | Tensor,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """See ``reference_losses.adam_step``; without host synchronisation."""
    if param.numel() == 0:
        return
    torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
        [param],
        [grad.to(param.dtype).contiguous()],
        [exp_avg],
        [exp_avg_sq],
        [],
        # torch.full is a kernel on the device: nothing is copied from the host.
        [step if isinstance(step, Tensor) else torch.full((), float(step), device=param.device)],
        lr=lr,
        beta1=betas[0],
        beta2=betas[1],
        weight_decay=0.0,
        eps=eps,
        amsgrad=False,
        maximize=False,
    )
