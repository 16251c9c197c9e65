# SPDX-License-Identifier: Apache-2.0
"""The rasteriser in this package's C++; the contract is ``kernels.reference_raster``'s."""

import ctypes
import weakref
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.errors import BackendError, OutOfMemoryError
from structgstream.kernels._load import native_library
from structgstream.kernels.raster_types import RasterOutput, tiles_of


def _pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


class _State:
    """Owns what forward leaves for backward."""

    def __init__(self, address: int | None) -> None:
        if not address:
            raise OutOfMemoryError("for the lists of the Gaussians that each tile draws")
        self.pointer = ctypes.c_void_p(address)
        weakref.finalize(self, native_library().sgs_raster_free, self.pointer)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        screen_offsets: Tensor | None,
        viewmat: Tensor,
        K: Tensor,
        background: Tensor | None,
        tiles: Tensor | None,
        onto: Tensor | None,
        size: tuple[int, int],
        near: float,
        trained: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        width, height = size
        count = means.shape[0]
        new = means.new_empty if tiles is None else means.new_zeros
        image = new(height, width, 3) if onto is None else onto
        alpha, radii = new(height, width), means.new_empty(count)
        if onto is not None:
            ctx.mark_dirty(onto)
        state = _State(
            native_library().sgs_raster_forward(
                ctypes.c_int64(count),
                *(_pointer(tensor) for tensor in (means, quats, scales, opacities, colors, viewmat, K)),
                ctypes.c_int(width),
                ctypes.c_int(height),
                ctypes.c_float(near),
                *(_pointer(tensor) for tensor in (background, screen_offsets, tiles)),
                ctypes.c_int64(trained),
                *(_pointer(tensor) for tensor in (image, alpha, radii)),
                ctypes.c_int(torch.get_num_threads()),
            )
        )
        ctx.state = state
        ctx.tracked = screen_offsets is not None
        ctx.save_for_backward(means, quats, scales, opacities, colors, background, image, alpha)
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        grad_image, grad_alpha, _ = gradients
        means, quats, scales, opacities, colors, background, image, alpha = ctx.saved_tensors
        given = torch.zeros_like(image) if grad_image is None else grad_image.contiguous()
        given_alpha = None if grad_alpha is None else grad_alpha.contiguous()
        results = [torch.empty_like(tensor) for tensor in (means, quats, scales, opacities, colors)]
        offsets = means.new_empty(means.shape[0], 2) if ctx.tracked else None
        failed = native_library().sgs_raster_backward(
            ctx.state.pointer,
            ctypes.c_int64(means.shape[0]),
            *(_pointer(t) for t in (means, quats, scales, opacities, colors, background, image, alpha)),
            *(_pointer(t) for t in (given, given_alpha, *results, offsets)),
            ctypes.c_int(torch.get_num_threads()),
        )
        if failed:
            raise OutOfMemoryError("for the gradients of the Gaussians that are drawn")
        return *results, offsets, *(None,) * 8


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
) -> RasterOutput:
    """Render Gaussians, see ``kernels.reference_raster.rasterize``. What is drawn ``onto`` is drawn in place.

    Repeated calls give the same bits, whatever the number of threads. Cameras and the background get no gradient.

    Raises:
        BackendError: a tensor is not float32 on the CPU.
        OutOfMemoryError: the lists of what each tile draws do not fit.
    """
    gaussians = (means, quats, scales, opacities, colors)
    given = gaussians if screen_offsets is None else (*gaussians, screen_offsets)
    n = means.shape[0]
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, 2)]
    assert [tuple(t.shape) for t in given] == shapes[: len(given)], [tuple(t.shape) for t in given]
    for tensor in given:
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise BackendError(
                f"The cpu back-end draws float32 tensors on the CPU, got {tensor.dtype} on {tensor.device}; "
                "convert them or take the reference back-end."
            )
    camera = [None if t is None else t.detach().float().contiguous() for t in (viewmat, K, background)]
    offsets = None if screen_offsets is None else screen_offsets.contiguous()
    if tiles is not None:
        assert tiles.shape == tiles_of(width, height), tiles.shape
        tiles = tiles.to(torch.uint8).contiguous()
    if onto is not None:
        assert onto.shape == (height, width, 3)
        assert onto.is_contiguous()
        assert not onto.requires_grad
        onto = onto.detach()  # An alias: autograd will make the result of what it is given.
    image, alpha, radii = _Rasterize.apply(  # type: ignore[misc]
        *(tensor.contiguous() for tensor in gaussians),
        offsets,
        *camera,
        tiles,
        onto,
        (width, height),
        near,
        n if trained is None else trained,
    )
    return RasterOutput(image, alpha, radii)


def blending_weights(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    maps: Tensor,
    *,
    near: float,
) -> Tensor:
    """Sums of blending weights ``[N, C]``, see ``kernels.reference_raster.blending_weights``; float32.

    Raises:
        OutOfMemoryError: the lists of what each tile draws do not fit.
    """
    tensors = [t.detach().float().contiguous() for t in (means, quats, scales, opacities, viewmat, K)]
    maps = maps.float().contiguous()
    height, width, channels = maps.shape
    assert channels > 0, maps.shape
    weights = torch.empty(means.shape[0], channels)
    failed = native_library().sgs_raster_weights(
        ctypes.c_int64(means.shape[0]),
        *(_pointer(tensor) for tensor in tensors),
        ctypes.c_int(width),
        ctypes.c_int(height),
        ctypes.c_float(near),
        _pointer(maps),
        ctypes.c_int(channels),
        _pointer(weights),
        ctypes.c_int(torch.get_num_threads()),
    )
    if failed:
        raise OutOfMemoryError("for the lists of the Gaussians that each tile draws")
    return weights
