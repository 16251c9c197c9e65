# SPDX-License-Identifier: Apache-2.0
"""Views drawn without gradients on a GPU by this package's kernels (csrc/cuda/picture_calls.h), in one call for all."""

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.cpu_raster import shape_arguments
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import constant, members
from structgstream.kernels.values import Rasterizer, RasterOutput, TileSelection, tile_grid

# The structures below mirror csrc/cuda/picture.h, member by member.


class _Gaussians(ctypes.Structure):
    _fields_ = (
        *members(ctypes.c_void_p, "means quats scales opacities colors intervals ids"),
        ("count", ctypes.c_int64),
    )


class _View(ctypes.Structure):
    _fields_ = (
        *members(_Gaussians, "gaussians statics"),
        *members(ctypes.c_void_p, "viewmat K background maps tiles image alpha radii sums"),
        *members(ctypes.c_int32, "width height channels"),
        ("near_plane", ctypes.c_float),
    )


class _Reach(ctypes.Structure):
    _fields_ = (
        ("gaussians", _Gaussians),
        *members(ctypes.c_void_p, "viewmat K reduced_K visible tiles"),
        *members(ctypes.c_int32, "width height reduced_width reduced_height"),
        *members(ctypes.c_float, "near_plane margin"),
    )


class _Call:
    """The arguments of a call, whose memory lives as long."""

    def __init__(self, library: KernelLibrary) -> None:
        self.library = library
        self.alive: list[Tensor | None] = []

    def at(self, *tensors: Tensor | None) -> list[int | None]:
        """Addresses of tensors, which are on the GPU."""
        self.library.check_devices(*tensors)
        self.alive.extend(tensors)
        return self.library.addresses(*tensors)

    def gaussians(self, given: Gaussians | None) -> _Gaussians:
        if given is None:
            return _Gaussians()
        ids = given.ids.contiguous()
        tensors = *shape_arguments(given), constant(given.colors), constant(given.sampling_intervals), ids
        return _Gaussians(*self.at(*tensors), len(given))

    def run(self, name: str, views: Sequence[ctypes.Structure], device: torch.device) -> None:
        array = (type(views[0]) * len(views))(*views)
        self.library.call(name, ctypes.addressof(array), len(views), device=device)


def _draw(
    library: KernelLibrary,
    gaussians: Sequence[Gaussians],
    viewports: Sequence[Viewport],
    *,
    static: Sequence[Gaussians] | None = None,
    backgrounds: Tensor | None = None,
    tiles: Sequence[TileSelection] | None = None,
    maps: Tensor | None = None,
    images: Sequence[Tensor] | Tensor | None = None,
    alphas: Tensor | None = None,
    radii: Sequence[Tensor] | None = None,
    sums: Tensor | None = None,
) -> None:
    """Fill those of ``images``, ``alphas``, ``radii`` and ``sums`` that are not None (csrc/cuda/picture.h)."""
    call, views = _Call(library), []
    backgrounds, maps = constant(backgrounds), constant(maps)
    for n, viewport in enumerate(viewports):
        size = (viewport.height, viewport.width)
        assert maps is None or maps.shape[1:3] == size, maps.shape
        given = (backgrounds, maps, None, images, alphas, radii, sums)
        background, of_maps, _, *results = (None if tensors is None else tensors[n] for tensors in given)
        mask = None if tiles is None else tiles[n].mask.contiguous()
        camera = constant(viewport.viewmat), constant(viewport.K)
        views.append(
            _View(
                call.gaussians(gaussians[n]),
                call.gaussians(None if static is None else static[n]),
                *call.at(*camera, background, of_maps, mask, *results),
                *(viewport.width, viewport.height, 0 if of_maps is None else of_maps.shape[-1], viewport.near),
            )
        )
    call.run("sgs_cuda_views", views, gaussians[0].means.device)


def draw_views(
    library: KernelLibrary,
    gaussians: Sequence[Gaussians],
    viewports: Sequence[Viewport],
    *,
    static: Sequence[Gaussians] | None = None,
    backgrounds: Tensor | None = None,
    tiles: Sequence[TileSelection] | None = None,
    onto: Sequence[Tensor] | None = None,
) -> list[RasterOutput]:
    """See ``reference_views``; waits once for the GPU. Results repeat bit for bit."""
    count, (width, height), device = len(viewports), viewports[0][3:5], gaussians[0].means.device
    images: Sequence[Tensor] | Tensor = torch.zeros(count, height, width, 3, device=device) if onto is None else onto
    alphas = torch.empty(count, height, width, device=device)
    lengths = [len(of_view) + (0 if static is None else len(static[n])) for n, of_view in enumerate(gaussians)]
    radii = torch.empty(sum(lengths), device=device).split(lengths)
    given = {"static": static, "backgrounds": backgrounds, "tiles": tiles}
    _draw(library, gaussians, viewports, **given, images=images, alphas=alphas, radii=radii)  # type: ignore[arg-type]
    return [RasterOutput(*results) for results in zip(images, alphas, radii, strict=True)]


def weigh_views(
    library: KernelLibrary,
    gaussians: Sequence[Gaussians],
    viewports: Sequence[Viewport],
    maps: Tensor,
    *,
    slots: int,
    static: Sequence[Gaussians] | None = None,
) -> Tensor:
    """See ``reference_views``; waits once for the GPU. Results repeat bit for bit."""
    sums = torch.zeros(len(viewports), slots, maps.shape[-1], device=maps.device)
    _draw(library, gaussians, viewports, static=static, maps=maps, sums=sums)
    return sums


def draw_and_weigh_views(
    library: KernelLibrary,
    gaussians: Sequence[Gaussians],
    viewports: Sequence[Viewport],
    maps: Tensor,
    *,
    slots: int,
    backgrounds: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """See ``reference_views``; waits once for the GPU. Results repeat bit for bit."""
    sums = torch.zeros(len(viewports), slots, maps.shape[-1], device=maps.device)
    images = torch.empty(*maps.shape[:3], 3, device=maps.device)
    _draw(library, gaussians, viewports, backgrounds=backgrounds, maps=maps, images=images, sums=sums)
    return images, sums


def reached_tiles(
    library: KernelLibrary,
    gaussians: Sequence[Gaussians],
    viewports: Sequence[Viewport],
    visible: Tensor,
    *,
    reduced: Sequence[Viewport],
    margin_pixels: int,
) -> Tensor:
    """See ``reference_views``; without waiting for the GPU."""
    call, device = _Call(library), visible.device
    found = torch.zeros(len(viewports), *tile_grid(*viewports[0][3:5]), dtype=torch.bool, device=device)
    visible = visible.contiguous()
    views = [
        _Reach(
            call.gaussians(gaussians[n]),
            *call.at(*map(constant, (viewport.viewmat, viewport.K, reduced[n].K)), visible[n], found[n]),
            *(viewport.width, viewport.height, reduced[n].width, reduced[n].height, viewport.near, margin_pixels),
        )
        for n, viewport in enumerate(viewports)
    ]
    call.run("sgs_cuda_reached_tiles", views, device)
    return found


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
        with_gradients: draws where a gradient is needed.
        gaussians: to draw.
        viewport: the camera.
        background: ``[3]``, black when None.
        options: the others of ``reference_raster.rasterize``.
    """
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    needed = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if needed or options.get("screen_offsets") is not None:
        return with_gradients(gaussians, viewport, background=background, **options)
    tiles, onto = options.get("tiles"), options.get("onto")
    (output,) = draw_views(
        library,
        [gaussians],
        [viewport],
        backgrounds=None if background is None else background[None],
        tiles=None if tiles is None else [tiles],
        onto=None if onto is None else [onto],
    )
    return output


def blending_weights(library: KernelLibrary, gaussians: Gaussians, viewport: Viewport, maps: Tensor) -> Tensor:
    """See ``reference_raster.blending_weights``; waits once for the GPU. Results repeat bit for bit."""
    rows = Gaussians(**{**gaussians.columns(), "ids": torch.arange(len(gaussians), device=maps.device)})
    return weigh_views(library, [rows], [viewport], maps[None], slots=len(gaussians))[0]
