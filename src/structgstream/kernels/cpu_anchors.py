# SPDX-License-Identifier: Apache-2.0
"""Anchors to drawable Gaussians in this package's C++; ``reference_anchors`` defines the operation."""

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.errors import BackendError, OutOfMemoryError
from structgstream.gaussians import Gaussians
from structgstream.kernels.native import addresses, constant, members, native_library
from structgstream.kernels.values import Anchors, MLPWeights, StructuredGaussians, TileSelection

# The structures below mirror csrc/cpu/anchors.h, member by member.


class _Head(ctypes.Structure):
    _fields_ = members(ctypes.c_void_p, "w1 b1 w2 b2")


Heads = _Head * 3


class _Anchors(ctypes.Structure):
    _fields_ = [
        *members(ctypes.c_void_p, "positions log_offset_scales log_base_scales offsets features visible"),
        ("heads", Heads),
        ("camera_center", ctypes.c_float * 3),
        *members(ctypes.c_int32, "visible_count offsets_per_anchor feature_size hidden_size distance_input"),
    ]


class _Selection(ctypes.Structure):
    _fields_ = [
        *members(ctypes.c_void_p, "raw_opacities relu_bits active starts"),
        *members(ctypes.c_int64, "active_count gaussian_count"),
    ]


class _Gaussians(ctypes.Structure):
    _fields_ = members(ctypes.c_void_p, "means quats scales opacities colors ids quat_norms")


class _GaussianGradients(ctypes.Structure):
    _fields_ = members(ctypes.c_void_p, "means quats scales opacities colors")


class _AnchorGradients(ctypes.Structure):
    _fields_ = [
        ("anchors", ctypes.c_int64),
        *members(ctypes.c_void_p, "positions log_offset_scales log_base_scales offsets features"),
        ("heads", Heads),
    ]


def native_heads(weights: Sequence[Tensor | None]) -> Any:
    """Four weights for each of the three heads in the form of csrc/cpu/anchors.h."""
    return Heads(*(_Head(*addresses(*weights[4 * head : 4 * head + 4])) for head in range(3)))


def _anchors(tensors: Sequence[Tensor], visible: Tensor, center: list[float], distance_input: bool) -> _Anchors:
    """``tensors``: the five anchor tensors, then four weights for each of the three heads."""
    return _Anchors(
        *addresses(*tensors[:5], visible),
        native_heads(tensors[5:]),
        (ctypes.c_float * 3)(*center),
        visible.shape[0],
        tensors[3].shape[1],
        tensors[4].shape[1],
        tensors[5].shape[0],
        int(distance_input),
    )


class _Generate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, visible: Tensor, center: list[float], distance_input: bool, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        library, threads = native_library(), torch.get_num_threads()
        m, k, hidden = visible.shape[0], tensors[3].shape[1], tensors[5].shape[0]
        raw = torch.empty(m, k)
        bits = torch.empty(m, 3, (hidden + 31) // 32, dtype=torch.int32)
        active, starts = torch.empty(m, dtype=torch.int32), torch.empty(m + 1, dtype=torch.int64)
        anchors = _anchors(tensors, visible, center, distance_input)
        selection = _Selection(*addresses(raw, bits, active, starts))
        library.sgs_anchors_select(ctypes.byref(anchors), ctypes.byref(selection), threads)
        n = selection.gaussian_count
        drawn = [torch.empty(n, 3), torch.empty(n, 4), torch.empty(n, 3), torch.empty(n), torch.empty(n, 3)]
        ids, norms = torch.empty(n, dtype=torch.int64), torch.empty(n)
        gaussians = _Gaussians(*addresses(*drawn, ids, norms))
        library.sgs_anchors_dress(ctypes.byref(anchors), ctypes.byref(selection), ctypes.byref(gaussians), threads)
        ctx.save_for_backward(visible, raw, bits, active, starts, ids, norms, *drawn, *tensors)
        ctx.arguments = center, distance_input, selection.active_count
        ctx.mark_non_differentiable(ids, raw)
        return *drawn, ids, raw

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        center, distance_input, active_count = ctx.arguments
        visible, raw, bits, active, starts, ids, norms, *saved = ctx.saved_tensors
        drawn, tensors = saved[:5], saved[5:]
        given = [gradient.contiguous() for gradient in gradients[:5]]
        wanted = ctx.needs_input_grad[3:]
        # The four tensors of a head are trained or frozen together; the C++ writes whole heads.
        head_wanted = [any(wanted[5 + 4 * head : 9 + 4 * head]) for head in range(3)]
        results = [
            torch.empty_like(tensor) if (wanted[index] if index < 5 else head_wanted[(index - 5) // 4]) else None
            for index, tensor in enumerate(tensors)
        ]
        native_library().sgs_anchors_backward(
            ctypes.byref(_anchors(tensors, visible, center, distance_input)),
            ctypes.byref(_Selection(*addresses(raw, bits, active, starts), active_count, ids.shape[0])),
            ctypes.byref(_Gaussians(*addresses(*drawn, ids, norms))),
            ctypes.byref(_GaussianGradients(*addresses(*given))),
            ctypes.byref(_AnchorGradients(len(tensors[0]), *addresses(*results[:5]), native_heads(results[5:]))),
            torch.get_num_threads(),
        )
        return None, None, None, *(result if want else None for result, want in zip(results, wanted, strict=True))


def _check(tensors: Sequence[Tensor], mlps: MLPWeights, distance_input: bool) -> None:
    m, k = tensors[3].shape[:2]
    d, hidden = tensors[4].shape[1], mlps.opacity.w1.shape[0]
    inputs = d + 3 + int(distance_input)
    expected = [(m, 3), (m, 3), (m, 3), (m, k, 3), (m, d)]
    for outputs in (k, 3 * k, 7 * k):
        expected += [(hidden, inputs), (hidden,), (outputs, hidden), (outputs,)]
    for tensor, shape in zip(tensors, expected, strict=True):
        if tensor.dtype != torch.float32 or tuple(tensor.shape) != shape:
            raise BackendError(
                f"The cpu back-end expected a float32 anchor or MLP tensor of shape {shape}, got "
                f"{tensor.dtype} {tuple(tensor.shape)}; the reference back-end takes other precisions."
            )


def visible_anchors(
    anchors: Anchors, viewport: Viewport, tiles: TileSelection | None, intervals: Tensor | None = None
) -> Tensor:
    """Indices ``[m]``, ascending, of the anchors in view, see ``reference_anchors.visible_anchors``.

    Raises:
        BackendError: a tensor of another precision.
        OutOfMemoryError: there is no memory for one byte per anchor.
    """
    tensors = anchors[:4]
    if any(tensor.dtype != torch.float32 for tensor in tensors):
        raise BackendError("The cpu back-end culls float32 anchors; the reference back-end takes other precisions.")
    assert tiles is None or (tiles.width, tiles.height) == (viewport.width, viewport.height), tiles
    tensors = [tensor.detach().contiguous() for tensor in tensors]
    count = len(anchors.positions)
    native = _Anchors(*addresses(*tensors, None, None))
    native.offsets_per_anchor = anchors.offsets.shape[1]
    viewmat, K = map(constant, (viewport.viewmat, viewport.K))
    mask = None if tiles is None else tiles.mask.contiguous()
    found = torch.empty(count, dtype=torch.int64)
    seen = native_library().sgs_anchors_visible(
        *(ctypes.byref(native), count, constant(intervals), viewmat, K, viewport.width, viewport.height, viewport.near),
        *(mask, found, torch.get_num_threads()),
    )
    if seen < 0:
        raise OutOfMemoryError("to find the anchors in view")
    return found[:seen]


def activate_anchors(
    anchors: Anchors, mlps: MLPWeights, center: Tensor, visible: Tensor, *, distance_input: bool
) -> StructuredGaussians:
    """The Gaussians of the anchors ``visible``, see ``reference_anchors.activate_anchors``.

    Raises:
        BackendError: a tensor of another precision, or inconsistent shapes.
    """
    tensors = [tensor.contiguous() for tensor in (*anchors, *(weight for head in mlps for weight in head))]
    _check(tensors, mlps, distance_input)
    visible = visible.to(torch.int64).contiguous()
    means, quats, scales, opacities, colors, ids, raw = _Generate.apply(  # type: ignore[misc]
        visible, center.tolist(), distance_input, *tensors
    )
    return StructuredGaussians(Gaussians(means, quats, scales, opacities, colors, ids), visible, raw)


def generate_structured(
    anchors: Anchors,
    mlps: MLPWeights,
    viewport: Viewport,
    *,
    distance_input: bool,
    tiles: TileSelection | None = None,
    sampling_intervals: Tensor | None = None,
) -> StructuredGaussians:
    """See ``reference_anchors.generate_structured``.

    Only gradients of tensors that require them are computed. Results do not depend on the number of threads.

    Raises:
        BackendError: a tensor of another precision, or inconsistent shapes.
        OutOfMemoryError: there is no memory for one byte per anchor.
    """
    visible = visible_anchors(anchors, viewport, tiles, sampling_intervals)
    return activate_anchors(anchors, mlps, viewport.center, visible, distance_input=distance_input)
