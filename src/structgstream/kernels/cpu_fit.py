# SPDX-License-Identifier: Apache-2.0
"""Iterations of a frame in this package's C++, without Python between them; ``values.FitFrame`` describes them."""

import ctypes
import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels.cpu_anchors import Heads, native_heads
from structgstream.kernels.native import addresses, constant, members, native_library
from structgstream.kernels.values import FIT_LEAVES, FitFrame, FitLeaf, FitView

# The structures below mirror csrc/include/structgstream.h, member by member.


class _Leaf(ctypes.Structure):
    _fields_ = [
        *members(ctypes.c_void_p, "values first second sums before"),
        *members(ctypes.c_int64, "count before_count"),
        ("step", ctypes.c_float),
    ]


class _View(ctypes.Structure):
    _fields_ = [
        *members(ctypes.c_void_p, "viewmat K center picture tiles changed mask gains biases background image"),
        *members(ctypes.c_void_p, "means quats scales opacities colors intervals"),
        ("static_count", ctypes.c_int64),
        ("near_plane", ctypes.c_float),
        *members(ctypes.c_int32, "width height"),
    ]


class _Frame(ctypes.Structure):
    _fields_ = [
        ("leaves", _Leaf * FIT_LEAVES),
        ("heads", Heads),
        *members(ctypes.c_void_p, "basis anchor_intervals free_intervals views neighbours shares start"),
        *members(ctypes.c_void_p, "order rests rates terms squared_errors"),
        *members(ctypes.c_int64, "anchors free neighbour_count"),
        *members(ctypes.c_int32, "view_count offsets_per_anchor feature_size hidden_size distance_input rank"),
        *members(ctypes.c_int32, "mean_volume mean_from errors_from"),
        *members(ctypes.c_float, "l1 ssim volume smoothness rate pixel slack"),
        *members(ctypes.c_double, "beta1 beta2 eps"),
    ]


def _leaf(leaf: FitLeaf | None) -> _Leaf:
    if leaf is None:
        return _Leaf()
    *tensors, step = leaf
    assert all(tensor is None or (tensor.is_contiguous() and tensor.dtype == torch.float32) for tensor in tensors)
    before = 0 if leaf.before is None else leaf.before.numel()
    return _Leaf(*addresses(*tensors), leaf.values.numel(), before, step)


def native_frame(frame: FitFrame) -> tuple[ctypes.Structure, list[Any]]:
    """``struct sgs_fit_frame`` of ``frame``, and what must live as long as it is used."""
    alive: list[Any] = [frame]

    def lasting(tensor: Tensor | None) -> Tensor | None:
        found = None if tensor is None else tensor.detach().contiguous()
        alive.append(found)
        return found

    def view(of: FitView) -> _View:
        cameras = [lasting(constant(tensor)) for tensor in of.viewport[:3]]
        static = of.static
        gaussians = (static.means, static.quats, static.scales, static.opacities, static.colors)
        assert of.image.is_contiguous()
        return _View(
            *addresses(*cameras, *map(lasting, (of.picture, of.tiles.mask, of.changed.mask, of.mask))),
            *addresses(*map(lasting, (of.gains, of.biases, of.background)), of.image),
            *addresses(*map(lasting, (*gaussians, static.sampling_intervals))),
            *(len(static), of.viewport.near, of.viewport.width, of.viewport.height),
        )

    factors, plan = frame.factors, frame.plan
    positions, offsets, features, means = (frame.leaves[n] for n in (0, 3, 4, 6))
    assert positions
    assert offsets
    assert features
    assert means
    views = (_View * len(frame.views))(*map(view, frame.views))
    alive.append(views)
    weights = [lasting(weight) for head in frame.mlps for weight in head]
    native = _Frame(
        (_Leaf * FIT_LEAVES)(*map(_leaf, frame.leaves)),
        native_heads(weights),
        *addresses(*map(lasting, (frame.basis, frame.anchor_intervals, frame.free_intervals))),
        ctypes.addressof(views),
        *addresses(*map(lasting, (frame.neighbours, frame.shares, frame.start))),
        *addresses(plan.order, plan.rests, plan.rates, plan.terms, plan.squared_errors),
        *(len(positions.values), len(means.values), 0 if frame.neighbours is None else frame.neighbours.shape[1]),
        *(
            len(views),
            offsets.values.shape[1],
            features.values.shape[1],
            len(frame.mlps.opacity.b1),
            int(frame.distance_input),
        ),
        *(0 if frame.basis is None else len(frame.basis), int(factors.mean_volume), plan.mean_from, plan.errors_from),
        *(factors.l1, factors.ssim, factors.volume, factors.smoothness, factors.rate, factors.pixel, factors.slack),
        *(*plan.betas, plan.eps),
    )
    return native, [*alive, native]


def iterations(frame: FitFrame) -> Callable[[int, int], None]:
    """The function that does iterations ``first`` to ``last`` (not included) of ``frame``: each once, in their order.

    Leaves, pictures and results are written in place. Results do not depend on the number of threads.

    Raises:
        OutOfMemoryError: there is no memory for what an iteration needs, here or in the function.
    """
    native, alive = native_frame(frame)
    library = native_library()
    fit = library.sgs_fit_new(ctypes.byref(native))
    if not fit:
        raise OutOfMemoryError("for the tensors of an iteration")

    def run(first: int, last: int) -> None:
        assert alive
        if library.sgs_fit_run(fit, first, last, torch.get_num_threads()):
            raise OutOfMemoryError("for the lists of the Gaussians that each tile draws")

    weakref.finalize(run, library.sgs_fit_free, fit)
    return run
