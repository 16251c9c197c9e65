# SPDX-License-Identifier: Apache-2.0
"""Pictures without gradients on a GPU in this package's kernels (csrc/cuda/picture_calls.h)."""

from typing import Any

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.cpu_raster import camera_arguments, shape_arguments
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import constant
from structgstream.kernels.values import Rasterizer, RasterOutput


def rasterize(
    library: KernelLibrary,
    with_gradients: Rasterizer,
    gaussians: Gaussians,
    viewport: Viewport,
    *,
    background: Tensor | None = None,
    **options: Any,
) -> RasterOutput:
    """See ``reference_raster.rasterize``; waits once for the GPU. Results repeat bit for bit.

    Args:
        library: the kernels.
        with_gradients: draws where a gradient is needed, or only some tiles.
        gaussians: to draw.
        viewport: the camera.
        background: ``[3]``, black when None.
        options: the others of ``reference_raster.rasterize``, for ``with_gradients``.
    """
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    needed = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if needed or any(options.get(name) is not None for name in ("screen_offsets", "tiles", "onto")):
        return with_gradients(gaussians, viewport, background=background, **options)
    size, device = (viewport.height, viewport.width), gaussians.means.device
    image, alpha = torch.empty(*size, 3, device=device), torch.empty(size, device=device)
    radii = torch.empty(len(gaussians), device=device)
    _draw(library, gaussians, viewport, background, None, None, image, alpha, radii)
    return RasterOutput(image, alpha, radii)


def projected_radii(library: KernelLibrary, gaussians: Gaussians, viewport: Viewport) -> Tensor:
    """See ``reference_raster.projected_radii``; without host synchronisation."""
    shape, intervals = shape_arguments(gaussians), constant(gaussians.sampling_intervals)
    library.check_devices(*shape, intervals, viewport.viewmat)
    radii = shape[0].new_empty(len(gaussians))
    library.call(
        "sgs_cuda_radii", len(gaussians), *shape, *camera_arguments(viewport), intervals, radii, device=radii.device
    )
    return radii


def blending_weights(library: KernelLibrary, gaussians: Gaussians, viewport: Viewport, maps: Tensor) -> Tensor:
    """See ``reference_raster.blending_weights``; waits once for the GPU. Results repeat bit for bit."""
    return _weights(library, gaussians, viewport, maps, None, None)


def picture_and_weights(
    library: KernelLibrary,
    gaussians: Gaussians,
    viewport: Viewport,
    maps: Tensor,
    *,
    background: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """See ``reference_raster.picture_and_weights``; waits once for the GPU. Results repeat bit for bit."""
    image = torch.empty(viewport.height, viewport.width, 3, device=gaussians.means.device)
    return image, _weights(library, gaussians, viewport, maps, background, image)


def _weights(
    library: KernelLibrary,
    gaussians: Gaussians,
    viewport: Viewport,
    maps: Tensor,
    background: Tensor | None,
    image: Tensor | None,
) -> Tensor:
    """The weights; ``image`` is drawn."""
    height, width, channels = maps.shape
    assert channels > 0, maps.shape
    assert (width, height) == (viewport.width, viewport.height), maps.shape
    weights = torch.empty(len(gaussians), channels, device=maps.device)
    _draw(library, gaussians, viewport, background, constant(maps), weights, image, None, None)
    return weights


def _draw(
    library: KernelLibrary,
    gaussians: Gaussians,
    viewport: Viewport,
    background: Tensor | None,
    maps: Tensor | None,
    weights: Tensor | None,
    image: Tensor | None,
    alpha: Tensor | None,
    radii: Tensor | None,
) -> None:
    """Fill those of ``weights``, ``image``, ``alpha`` and ``radii`` that are not None (csrc/cuda/picture.h)."""
    shape, colors = shape_arguments(gaussians), None if image is None else constant(gaussians.colors)
    background, intervals = constant(background), constant(gaussians.sampling_intervals)
    library.check_devices(*shape, colors, intervals, background, viewport.viewmat, maps)
    library.call(
        "sgs_cuda_picture",
        *(len(gaussians), *shape, colors, *camera_arguments(viewport), background, intervals),
        *(maps, 0 if maps is None else maps.shape[2], weights, image, alpha, radii),
        device=shape[0].device,
    )
