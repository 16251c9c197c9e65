# SPDX-License-Identifier: Apache-2.0
"""Pictures without gradients on a GPU in this package's kernels (csrc/cuda/picture_calls.h)."""

from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import constant


def _shape(gaussians: Gaussians) -> list[Tensor]:
    return [constant(t) for t in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)]


def _camera(viewport: Viewport) -> list[Tensor | int | float]:
    return [constant(viewport.viewmat), constant(viewport.K), viewport.width, viewport.height, viewport.near]


def _intervals(gaussians: Gaussians) -> Tensor | None:
    return None if gaussians.sampling_intervals is None else constant(gaussians.sampling_intervals)


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
