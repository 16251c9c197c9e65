# SPDX-License-Identifier: Apache-2.0
"""Pictures without gradients on a GPU in this package's kernels (csrc/cuda/picture_calls.h)."""

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import constant
from structgstream.kernels.values import Rasterizer, RasterOutput, TileSelection


def _attributes(gaussians: Gaussians) -> tuple[Tensor, ...]:
    return gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities


def _shape(gaussians: Gaussians) -> list[Tensor]:
    return [constant(tensor) for tensor in _attributes(gaussians)]


def _camera(viewport: Viewport) -> list[Tensor | int | float]:
    return [constant(viewport.viewmat), constant(viewport.K), viewport.width, viewport.height, viewport.near]


def _intervals(gaussians: Gaussians) -> Tensor | None:
    return None if gaussians.sampling_intervals is None else constant(gaussians.sampling_intervals)


def rasterize(
    library: KernelLibrary,
    with_gradients: Rasterizer,
    gaussians: Gaussians,
    viewport: Viewport,
    *,
    background: Tensor | None = None,
    screen_offsets: Tensor | None = None,
    tiles: TileSelection | None = None,
    onto: Tensor | None = None,
    trained: int | None = None,
) -> RasterOutput:
    """See ``reference_raster.rasterize``; waits once for the GPU. Results repeat bit for bit.

    Args:
        library: the kernels.
        with_gradients: draws where a gradient is needed, or only some tiles.
        gaussians: to draw.
        viewport: the camera.
        background: ``[3]``, black when None.
        screen_offsets: for ``with_gradients``, as the following.
        tiles: as above.
        onto: as above.
        trained: as above.
    """
    tensors = (*_attributes(gaussians), gaussians.colors)
    needed = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if needed or screen_offsets is not None or tiles is not None:
        return with_gradients(
            gaussians,
            viewport,
            background=background,
            screen_offsets=screen_offsets,
            tiles=tiles,
            onto=onto,
            trained=trained,
        )
    assert onto is None, "a picture to draw onto needs tiles"
    *shape, colors = map(constant, tensors)
    intervals, background = _intervals(gaussians), None if background is None else constant(background)
    library.check_devices(*shape, colors, intervals, viewport.viewmat, background)
    image, alpha = (colors.new_empty(viewport.height, viewport.width, *more) for more in ((3,), ()))
    radii = colors.new_empty(len(gaussians))
    library.call(
        "sgs_cuda_picture",
        *(len(gaussians), *shape, colors, *_camera(viewport), background, intervals),
        *(None, 0, None, image, alpha, radii),
        device=colors.device,
    )
    return RasterOutput(image, alpha, radii)


def projected_radii(library: KernelLibrary, gaussians: Gaussians, viewport: Viewport) -> Tensor:
    """See ``reference_raster.projected_radii``; without host synchronisation."""
    shape, intervals = _shape(gaussians), _intervals(gaussians)
    library.check_devices(*shape, intervals, viewport.viewmat)
    radii = shape[0].new_empty(len(gaussians))
    library.call("sgs_cuda_radii", len(gaussians), *shape, *_camera(viewport), intervals, radii, device=shape[0].device)
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
    image = gaussians.means.new_empty(viewport.height, viewport.width, 3)
    weights = _weights(library, gaussians, viewport, maps, background, image)
    return image, weights


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
    shape, intervals, maps = _shape(gaussians), _intervals(gaussians), constant(maps)
    colors = None if image is None else constant(gaussians.colors)
    background = None if background is None else constant(background)
    library.check_devices(*shape, intervals, viewport.viewmat, maps, colors, background)
    weights = maps.new_empty(len(gaussians), channels)
    library.call(
        "sgs_cuda_picture",
        *(len(gaussians), *shape, colors, *_camera(viewport), background, intervals),
        *(maps, channels, weights, image, None, None),
        device=maps.device,
    )
    return weights
