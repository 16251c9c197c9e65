# SPDX-License-Identifier: Apache-2.0
"""The rasteriser in this package's C++; ``reference_raster`` defines its operations."""

import weakref
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.cameras import Viewport
from structgstream.errors import BackendError, OutOfMemoryError
from structgstream.gaussians import Gaussians
from structgstream.kernels.native import constant, native_library
from structgstream.kernels.values import RasterOutput, TileSelection


class _State:
    """Owns the native state that forward stores for backward."""

    def __init__(self, address: int | None) -> None:
        if not address:
            raise OutOfMemoryError("for the lists of the Gaussians that each tile draws")
        self.address = address
        weakref.finalize(self, native_library().sgs_raster_free, address)


@dataclass(frozen=True)
class Scenery:
    """The arguments of ``rasterize`` that have no gradient, for CPU and CUDA: contiguous, numbers float32."""

    viewport: Viewport
    background: Tensor | None
    tiles: Tensor | None
    trained: int
    intervals: Tensor | None

    @classmethod
    def of(
        cls,
        gaussians: Gaussians,
        viewport: Viewport,
        background: Tensor | None,
        tiles: TileSelection | None,
        trained: int | None,
    ) -> "Scenery":
        """Of the arguments of ``rasterize``."""
        mask = None if tiles is None else tiles.mask.contiguous()
        count = len(gaussians) if trained is None else min(trained, len(gaussians))
        return cls(viewport, constant(background), mask, count, constant(gaussians.sampling_intervals))


def shape_arguments(gaussians: Gaussians) -> list[Tensor]:
    """Means, quaternions, scales and opacities for a C function: float32, contiguous, without gradient."""
    return [constant(t) for t in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)]


def camera_arguments(viewport: Viewport) -> list[Tensor | int | float]:
    """A camera in the order of the C functions' arguments."""
    return [constant(viewport.viewmat), constant(viewport.K), viewport.width, viewport.height, viewport.near]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, view: Scenery, onto: Tensor | None, screen_offsets: Tensor | None, *gaussians: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``gaussians``: means, quaternions, scales, opacities and colours."""
        means, count = gaussians[0], gaussians[0].shape[0]
        width, height = view.viewport.width, view.viewport.height
        new = means.new_empty if view.tiles is None else means.new_zeros
        image = new(height, width, 3) if onto is None else onto
        alpha, radii = new(height, width), means.new_empty(count)
        if onto is not None:
            ctx.mark_dirty(onto)
        ctx.state = _State(
            native_library().sgs_raster_forward(
                count,
                *gaussians,
                *camera_arguments(view.viewport),
                *(view.background, screen_offsets, view.intervals, view.tiles, view.trained),
                *(image, alpha, radii, torch.get_num_threads()),
            )
        )
        ctx.background, ctx.tracked = view.background, screen_offsets is not None
        ctx.save_for_backward(image, alpha, *gaussians)
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        grad_image, grad_alpha, _ = gradients
        image, alpha, *gaussians = ctx.saved_tensors
        given = torch.zeros_like(image) if grad_image is None else grad_image.contiguous()
        given_alpha = None if grad_alpha is None else grad_alpha.contiguous()
        results = [torch.empty_like(tensor) for tensor in gaussians]
        count = gaussians[0].shape[0]
        offsets = image.new_empty(count, 2) if ctx.tracked else None
        if native_library().sgs_raster_backward(
            *(ctx.state.address, count, *gaussians, ctx.background, image, alpha, given, given_alpha),
            *(*results, offsets, torch.get_num_threads()),
        ):
            raise OutOfMemoryError("for the gradients of the Gaussians that are drawn")
        return None, None, offsets, *results


def rasterize(
    gaussians: Gaussians,
    viewport: Viewport,
    *,
    background: Tensor | None = None,
    screen_offsets: Tensor | None = None,
    tiles: TileSelection | None = None,
    onto: Tensor | None = None,
    trained: int | None = None,
) -> RasterOutput:
    """See ``reference_raster.rasterize``. Results repeat bit for bit and do not depend on the number of threads.

    Raises:
        BackendError: a tensor is not float32 on the CPU.
        OutOfMemoryError: there is no memory for the tiles' lists of Gaussians.
    """
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    given = tensors if screen_offsets is None else (*tensors, screen_offsets)
    n = len(gaussians)
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, 2)]
    assert [tuple(t.shape) for t in given] == shapes[: len(given)], [tuple(t.shape) for t in given]
    for tensor in given:
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise BackendError(
                f"The cpu back-end draws float32 tensors on the CPU, got {tensor.dtype} on {tensor.device}; "
                "convert them or take the reference back-end."
            )
    assert tiles is None or (tiles.width, tiles.height) == (viewport.width, viewport.height), tiles
    if onto is not None:
        assert tiles is not None, "a picture to draw onto needs tiles"
        assert onto.shape == (viewport.height, viewport.width, 3)
        assert onto.is_contiguous()
        assert not onto.requires_grad
        onto = onto.detach()  # An alias, because autograd marks the tensor it is given as the function's result.
    view = Scenery.of(gaussians, viewport, background, tiles, trained)
    offsets = None if screen_offsets is None else screen_offsets.contiguous()
    image, alpha, radii = _Rasterize.apply(  # type: ignore[misc]
        view, onto, offsets, *(tensor.contiguous() for tensor in tensors)
    )
    return RasterOutput(image, alpha, radii)


def projected_radii(gaussians: Gaussians, viewport: Viewport) -> Tensor:
    """See ``reference_raster.projected_radii``; float32.

    Raises:
        OutOfMemoryError: there is no memory for the projected Gaussians.
    """
    radii = torch.empty(len(gaussians))
    if native_library().sgs_raster_radii(
        *(len(gaussians), *shape_arguments(gaussians), *camera_arguments(viewport)),
        *(constant(gaussians.sampling_intervals), radii, torch.get_num_threads()),
    ):
        raise OutOfMemoryError("to project Gaussians")
    return radii


def blending_weights(gaussians: Gaussians, viewport: Viewport, maps: Tensor) -> Tensor:
    """See ``reference_raster.blending_weights``; float32.

    Raises:
        OutOfMemoryError: there is no memory for the tiles' lists of Gaussians.
    """
    return _weights(gaussians, viewport, maps, background=None, image=None)


def picture_and_weights(
    gaussians: Gaussians, viewport: Viewport, maps: Tensor, *, background: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """See ``reference_raster.picture_and_weights``; float32, in one pass.

    Raises:
        OutOfMemoryError: there is no memory for the tiles' lists of Gaussians.
    """
    image = torch.empty(viewport.height, viewport.width, 3)
    return image, _weights(gaussians, viewport, maps, background=background, image=image)


def _weights(
    gaussians: Gaussians, viewport: Viewport, maps: Tensor, *, background: Tensor | None, image: Tensor | None
) -> Tensor:
    colors = None if image is None else constant(gaussians.colors)
    maps = maps.float().contiguous()
    height, width, channels = maps.shape
    assert channels > 0, maps.shape
    assert (width, height) == (viewport.width, viewport.height), maps.shape
    weights = torch.empty(len(gaussians), channels)
    if native_library().sgs_raster_weights(
        *(len(gaussians), *shape_arguments(gaussians), colors, *camera_arguments(viewport)),
        *(constant(background), constant(gaussians.sampling_intervals)),
        *(maps, channels, weights, image, torch.get_num_threads()),
    ):
        raise OutOfMemoryError("for the lists of the Gaussians that each tile draws")
    return weights
