# SPDX-License-Identifier: Apache-2.0
"""Operations of the cuda back-end in this package's kernels (losses, sweeps, the lift), and torch's Adam."""

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from structgstream.kernels.cpu_losses import Comparison
from structgstream.kernels.cuda_library import KernelLibrary, library_reason
from structgstream.kernels.native import constant, members
from structgstream.kernels.values import Lifted, Neighbors, SweepView, Swept, TileSelection, ViewFlows, tile_grid


def cuda_reason() -> str | None:
    """Why the back-end is not available on this machine and how to get it; None if it is."""
    if torch.cuda.is_available():
        return library_reason()
    try:
        torch.cuda.init()
        cause = "it finds none"
    except (RuntimeError, AssertionError) as error:  # An old driver, none, or a torch without CUDA.
        cause = str(error).partition(". ")[0].rstrip(".")
    return f"torch {torch.__version__} cannot use an NVIDIA GPU ({cause}); it needs a driver and a CUDA build of torch."


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
    assert neighbors.affinities.shape == (targets, count), neighbors.affinities.shape
    assert priors.shape == (targets, 3), priors.shape
    assert seen.viewmats.shape == (views, 4, 4), seen.viewmats.shape
    assert seen.Ks.shape == (views, 3, 3), seen.Ks.shape
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
    lr: float,
    step: int,
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
        [torch.full((), float(step), device=param.device)],
        lr=lr,
        beta1=betas[0],
        beta2=betas[1],
        weight_decay=0.0,
        eps=eps,
        amsgrad=False,
        maximize=False,
    )
