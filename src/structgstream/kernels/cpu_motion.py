# SPDX-License-Identifier: Apache-2.0
"""Changes and motion between pictures, in this package's C++; ``reference_motion`` defines the operations.

All of them are float32, and their results do not depend on the number of threads.
"""

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels.native import addresses, constant, members, native_library
from structgstream.kernels.values import Lifted, Neighbors, SweepView, Swept, TileSelection, ViewFlows

# The structures below mirror csrc/include/structgstream.h, member by member.


class _Residual(ctypes.Structure):
    _fields_ = (
        *members(ctypes.c_void_p, "rendering gains biases picture tiles outside mask"),
        *members(ctypes.c_int, "height width reduced_height reduced_width"),
    )


class _View(ctypes.Structure):
    _fields_ = (
        *members(ctypes.c_void_p, "colors missing depths"),
        ("viewmat", ctypes.c_float * 12),
        ("K", ctypes.c_float * 9),
        ("near_plane", ctypes.c_float),
        *members(ctypes.c_int, "width height"),
    )


class _Neighbour(ctypes.Structure):
    _fields_ = (("picture", ctypes.c_void_p), *members(ctypes.c_int, "width height"))


def changed_pixels(before: Tensor, now: Tensor, *, threshold: float, reach_pixels: int) -> Tensor:
    """See ``reference_motion.changed_pixels``.

    Raises:
        OutOfMemoryError: there is no memory for three bytes per pixel.
    """
    assert before.shape == now.shape, (before.shape, now.shape)
    assert before.dtype == now.dtype == torch.uint8, (before.dtype, now.dtype)
    size, limits = now.shape[-3:-1], (threshold, reach_pixels)
    changed = torch.empty(now.shape[:-1], dtype=torch.uint8)
    pictures = (t.contiguous().reshape(-1, *t.shape[-3:]) for t in (before, now))
    for of_view, *pair in zip(changed.view(-1, *size), *pictures, strict=True):
        if native_library().sgs_changed_pixels(*pair, *size, *limits, of_view, torch.get_num_threads()):
            raise OutOfMemoryError("to compare two pictures")
    return changed.bool()


def picture_residuals(
    renderings: Sequence[Tensor],
    pictures: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: Sequence[TileSelection] | None = None,
    outside: Sequence[Tensor] | None = None,
    masks: Tensor | None = None,
) -> Tensor:
    """See ``reference_motion.picture_residuals``.

    Raises:
        OutOfMemoryError: there is no memory for the differences.
    """
    assert (tiles is None) == (outside is None), "tiles need pictures for the pixels outside them"
    assert (gains is None) == (biases is None), "gains and biases belong together"
    assert pictures.dtype == torch.uint8, pictures.dtype
    assert masks is None or masks.shape == pictures.shape[:3], (masks.shape, pictures.shape)
    found, pictures = torch.empty(pictures.shape[:3]), pictures.contiguous()
    for n, rendering in enumerate(renderings):
        assert outside is None or outside[n].shape == rendering.shape, (outside[n].shape, rendering.shape)
        floats = [constant(t) for t in (rendering, *(None if t is None else t[n] for t in (gains, biases)))]
        bytes_ = [None if t is None else t[n].contiguous() for t in (outside, masks)]
        mask = None if tiles is None else tiles[n].mask.contiguous()
        given = _Residual(*addresses(*floats, pictures[n], mask, *bytes_), *rendering.shape[:2], *pictures.shape[1:3])
        if native_library().sgs_picture_residual(ctypes.byref(given), found[n]):
            raise OutOfMemoryError("to compare a rendering with its picture")
    return found


def confident_flow(flow: Tensor, back: Tensor, mask: Tensor | None, *, relative: float, absolute: float) -> Tensor:
    """See ``reference_motion.confident_flow``."""
    assert flow.shape == back.shape, (flow.shape, back.shape)
    assert flow.dtype == back.dtype == torch.float32, (flow.dtype, back.dtype)
    height, width = flow.shape[:2]
    given = flow.contiguous(), back.contiguous(), None if mask is None else mask.contiguous()
    maps = torch.empty(3, height, width)
    native_library().sgs_confident_flow(*given, height, width, relative, absolute, maps, torch.get_num_threads())
    return maps


def lift(centers: Tensor, seen: ViewFlows, neighbors: Neighbors, priors: Tensor, *, share: float) -> Lifted:
    """See ``reference_motion.lift``.

    Raises:
        OutOfMemoryError: there is no memory for the terms of one target per thread.
    """
    views, dynamic = seen.weights.shape
    targets, count = neighbors.rows.shape
    assert centers.shape == (dynamic, 3), centers.shape
    assert seen.flows.shape == (views, dynamic, 2), seen.flows.shape
    assert neighbors.affinities.shape == (targets, count), neighbors.affinities.shape
    assert priors.shape == (targets, 3), priors.shape
    assert seen.viewmats.shape == (views, 4, 4), seen.viewmats.shape
    assert seen.Ks.shape == (views, 3, 3), seen.Ks.shape
    rows = neighbors.rows.to(torch.int64).contiguous()
    assert not targets or 0 <= int(rows.min()) <= int(rows.max()) < dynamic, "rows of dynamic anchors and Gaussians"
    observed, pulls = map(constant, (centers, *seen)), map(constant, (neighbors.affinities, priors))
    sizes = dynamic, targets, views, count
    found = torch.empty(targets, 3), torch.empty(targets), torch.empty(targets, dtype=torch.int64)
    if native_library().sgs_lift_flow(*observed, rows, *pulls, *sizes, share, *found, torch.get_num_threads()):
        raise OutOfMemoryError("to lift flow to displacements")
    return Lifted(*found)


def sweep(
    views: Sequence[SweepView],
    view_index: int,
    pixels: Tensor,
    farthest: Tensor,
    *,
    planes: int,
    min_supports: int,
    max_contradictions: float,
) -> Swept:
    """See ``reference_motion.sweep``."""
    assert len(pixels) == len(farthest), (pixels.shape, farthest.shape)
    inputs = [[constant(t) for t in (view.colors, view.missing, view.depths)] for view in views]
    given = (_View * len(views))()
    for slot, view, tensors in zip(given, views, inputs, strict=True):
        slot.height, slot.width = view.missing.shape
        assert view.colors.shape == (slot.height, slot.width, 3), view.colors.shape
        assert view.depths.shape == view.missing.shape, view.depths.shape
        slot.colors, slot.missing, slot.depths = addresses(*tensors)
        slot.viewmat[:] = view.viewmat[:3].reshape(-1).tolist()
        slot.K[:] = view.K.reshape(-1).tolist()
        slot.near_plane = view.near
    rays = pixels.to(torch.int64).contiguous(), farthest.float().contiguous(), len(pixels)
    rules = planes, min_supports, max_contradictions
    found = torch.empty(len(pixels)), torch.empty(len(pixels))
    native_library().sgs_sweep(given, len(views), view_index, *rays, *rules, *found, torch.get_num_threads())
    return Swept(*found)


def plane_scores(
    picture: Tensor, neighbours: Sequence[Tensor], homographies: Tensor, *, window: int, noise: float
) -> Tensor:
    """See ``reference_motion.plane_scores``; in one thread.

    Raises:
        OutOfMemoryError: there is no memory for sums over windows.
    """
    planes, count = homographies.shape[:2]
    assert count == len(neighbours) > 0, (count, len(neighbours))
    assert window % 2 == 1, window
    inputs = [neighbour.float().contiguous() for neighbour in neighbours]
    given = (_Neighbour * count)(*((other.data_ptr(), other.shape[1], other.shape[0]) for other in inputs))
    picture, homographies = picture.float().contiguous(), homographies.double().contiguous()
    scores = torch.empty(planes, *picture.shape)
    if native_library().sgs_plane_scores(
        picture, *picture.shape, given, count, homographies, planes, window, noise, scores
    ):
        raise OutOfMemoryError("to sweep planes through a picture")
    return scores
