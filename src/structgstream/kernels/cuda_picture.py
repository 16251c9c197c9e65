# SPDX-License-Identifier: Apache-2.0
"""Views drawn on a GPU by this package's kernels (csrc/cuda/picture_calls.h): several without gradients in one call, or
one with gradients.
"""

import ctypes
import weakref
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.cameras import Camera, Viewport
from structgstream.environment import pixel_to_world
from structgstream.errors import BackendError
from structgstream.gaussians import Gaussians
from structgstream.kernels.cpu_raster import Scenery, shape_arguments
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.native import constant, members
from structgstream.kernels.values import RasterOutput, TileSelection, tile_grid

# The structures below mirror csrc/cuda/picture.h, member by member.


class _Gaussians(ctypes.Structure):
    _fields_ = (
        *members(ctypes.c_void_p, "means quats scales opacities colors intervals screen_offsets ids"),
        ("count", ctypes.c_int64),
    )


class _View(ctypes.Structure):
    _fields_ = (
        *members(_Gaussians, "gaussians statics"),
        *members(ctypes.c_void_p, "viewmat K background maps tiles image alpha radii sums"),
        *members(ctypes.c_int32, "width height channels"),
        ("near_plane", ctypes.c_float),
    )


class _Gradients(ctypes.Structure):
    _fields_ = members(ctypes.c_void_p, "means quats scales opacities colors screen_offsets")


class _Reach(ctypes.Structure):
    _fields_ = (
        ("gaussians", _Gaussians),
        *members(ctypes.c_void_p, "viewmat K reduced_K visible tiles"),
        *members(ctypes.c_int32, "width height reduced_width reduced_height"),
        *members(ctypes.c_float, "near_plane margin"),
    )


class _Display(ctypes.Structure):
    _fields_ = (
        *members(ctypes.c_void_p, "image alpha environment picture"),
        ("pixel_to_world", ctypes.c_float * 9),
        *members(ctypes.c_int32, "width height terms"),
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
        tensors = *shape_arguments(given), constant(given.colors), constant(given.sampling_intervals), None, ids
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


def display(library: KernelLibrary, image: Tensor, alpha: Tensor, camera: Camera, environment: Tensor | None) -> Tensor:
    """See ``reference_raster.display``; without waiting for the GPU."""
    picture = torch.empty(image.shape, dtype=torch.uint8, device=image.device)
    given = (image.contiguous(), alpha.contiguous(), constant(environment), picture)
    library.check_devices(*given)
    rays = pixel_to_world(camera).flatten().tolist() if environment is not None else [0.0] * 9
    terms = 0 if environment is None else len(environment)
    call = _Display(*library.addresses(*given), (ctypes.c_float * 9)(*rays), camera.width, camera.height, terms)
    library.call("sgs_cuda_display", ctypes.addressof(call), device=image.device)
    return picture


class _Raster:
    """Owns what the kernels keep of a drawing for its gradients, and the memory that they read."""

    def __init__(self, call: _Call, view: _View, device: torch.device) -> None:
        self.call, self.address = call, ctypes.c_void_p()
        weakref.finalize(self, call.library.library.sgs_cuda_raster_free, self.address)
        places = ctypes.addressof(view), ctypes.addressof(self.address)
        call.library.call("sgs_cuda_raster_new", *places, device=device)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        library: KernelLibrary,
        scenery: Scenery,
        onto: Tensor | None,
        screen_offsets: Tensor | None,
        *gaussians: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``gaussians``: means, quaternions, scales, opacities and colours."""
        means, viewport, trained = gaussians[0], scenery.viewport, scenery.trained
        size = viewport.height, viewport.width
        new = means.new_empty if scenery.tiles is None else means.new_zeros
        image = new(*size, 3) if onto is None else onto
        alpha, radii = means.new_empty(size), means.new_empty(len(means))
        if onto is not None:
            ctx.mark_dirty(onto)
        call, rows = _Call(library), (*gaussians, scenery.intervals, screen_offsets)
        sets = [
            _Gaussians(*call.at(*(None if tensor is None else tensor[part] for tensor in rows), None), count)
            for part, count in ((slice(trained), trained), (slice(trained, None), len(means) - trained))
        ]
        camera = constant(viewport.viewmat), constant(viewport.K)
        # Not the results themselves, which refer to this function.
        results = image.detach(), alpha.detach(), radii.detach()
        view = _View(
            *sets,
            *call.at(*camera, scenery.background, None, scenery.tiles, *results, None),
            *(viewport.width, viewport.height, 0, viewport.near),
        )
        ctx.raster, ctx.tracked = _Raster(call, view, means.device), screen_offsets is not None
        ctx.save_for_backward(image, *gaussians)
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *gradients: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        to_image, to_alpha, _ = gradients
        image, *gaussians = ctx.saved_tensors
        to_image = torch.zeros_like(image) if to_image is None else to_image.contiguous()
        to_alpha = None if to_alpha is None else to_alpha.contiguous()
        found = [torch.empty_like(tensor) for tensor in gaussians]
        offsets = image.new_empty(len(gaussians[0]), 2) if ctx.tracked else None
        library = ctx.raster.call.library
        written = _Gradients(*library.addresses(*found, offsets))
        given = ctx.raster.address, to_image, to_alpha, ctypes.addressof(written)
        library.call("sgs_cuda_raster_backward", *given, device=image.device)
        return None, None, None, offsets, *found


def rasterize(
    library: KernelLibrary,
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

    Raises:
        BackendError: a tensor that needs a gradient is not float32.
        OutOfMemoryError: the GPU has no memory for the tiles' lists of Gaussians, or for the gradients of their pairs.
    """
    assert tiles is None or (tiles.width, tiles.height) == (viewport.width, viewport.height), tiles
    assert onto is None or tiles is not None, "a picture to draw onto needs tiles"
    tensors = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    needed = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if not needed and screen_offsets is None:
        (output,) = draw_views(
            library,
            [gaussians],
            [viewport],
            backgrounds=None if background is None else background[None],
            tiles=None if tiles is None else [tiles],
            onto=None if onto is None else [onto],
        )
        return output
    given = tensors if screen_offsets is None else (*tensors, screen_offsets)
    if any(tensor.dtype != torch.float32 for tensor in given):
        raise BackendError("The cuda back-end draws float32 Gaussians; convert them, or take the reference back-end.")
    if onto is not None:
        assert onto.shape == (viewport.height, viewport.width, 3)
        assert onto.is_contiguous()
        assert not onto.requires_grad
        onto = onto.detach()  # An alias, because autograd marks the tensor it is given as the function's result.
    scenery = Scenery.of(gaussians, viewport, background, tiles, trained)
    offsets = None if screen_offsets is None else screen_offsets.contiguous()
    leaves = onto, offsets, *(tensor.contiguous() for tensor in tensors)
    return RasterOutput(*_Rasterize.apply(library, scenery, *leaves))  # type: ignore[misc]
