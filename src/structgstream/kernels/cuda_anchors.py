# SPDX-License-Identifier: Apache-2.0
"""Anchors to Gaussians on a GPU: this package's kernels around torch's matrix products.

Note [Shapes without waiting]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
The numbers of anchors in view and of Gaussians with positive opacity are known only on the GPU, and the host has to
synchronise to gather these rows. :func:`generate_structured` does; :func:`generate_views` returns all ``M * K + F``
Gaussians of each view instead. Those that are not drawn have opacity 0 and scale 0, and every rasteriser skips them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.cameras import Viewport
from structgstream.errors import BackendError
from structgstream.gaussians import Gaussians
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import Anchors, MLPWeights, StructuredGaussians, TileSelection


def head_outputs(mlps: MLPWeights, inputs: Tensor) -> list[Tensor]:
    """Outputs of each head before activation."""
    # One product for the three first layers, because the cost of small products is their launch.
    first, bias = torch.cat([head.w1 for head in mlps]), torch.cat([head.b1 for head in mlps])
    hidden = torch.relu(torch.nn.functional.linear(inputs, first, bias))
    parts = hidden.split([head.w1.shape[0] for head in mlps], dim=1)
    return [torch.nn.functional.linear(part, head.w2, head.b2) for part, head in zip(parts, mlps, strict=True)]


class _KernelCamera(NamedTuple):
    """A camera, as the kernels read it."""

    library: KernelLibrary
    viewport: Viewport
    center: Tensor
    tiles: Tensor | None
    intervals: Tensor | None
    distance_input: bool


class _Inputs(torch.autograd.Function):
    """The MLPs' inputs ``[M, I]`` and the mask ``[M]`` of the anchors that are seen."""

    @staticmethod
    def forward(ctx: Any, camera: _KernelCamera, *anchors: Tensor) -> tuple[Tensor, Tensor]:
        positions, log_offset_scales, log_base_scales, offsets, features = anchors
        (m, k), d, view = offsets.shape[:2], features.shape[1], camera.viewport
        inputs = features.new_empty(m, d + 3 + camera.distance_input)
        seen = torch.empty(m, dtype=torch.bool, device=features.device)
        camera.library.call(
            "sgs_cuda_anchor_inputs",
            *(positions, log_offset_scales, log_base_scales, offsets, features, camera.intervals),
            *(m, k, d, int(camera.distance_input), 1),
            *(view.viewmat, view.K, camera.center, view.width, view.height, view.near),
            *(camera.tiles, inputs, seen),
            device=positions.device,
        )
        ctx.camera, ctx.feature_size = camera, d
        ctx.save_for_backward(positions)
        ctx.mark_non_differentiable(seen)
        return inputs, seen

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (positions,) = ctx.saved_tensors
        camera, d, v_inputs = ctx.camera, ctx.feature_size, gradients[0].contiguous()
        v_positions = None
        if ctx.needs_input_grad[1]:
            v_positions = torch.empty_like(positions)
            camera.library.call(
                "sgs_cuda_anchor_inputs_backward",
                *(positions, len(positions), d, int(camera.distance_input)),
                *(camera.center, v_inputs, v_positions),
                device=positions.device,
            )
        v_features = v_inputs[:, :d] if ctx.needs_input_grad[5] else None
        return None, v_positions, None, None, None, v_features


class _Outputs(torch.autograd.Function):
    """The five attributes of the Gaussians ``[M K, ...]``, raw opacities ``[M, K]`` and ids ``[M K]``."""

    @staticmethod
    def forward(ctx: Any, library: KernelLibrary, seen: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        positions, log_offset_scales, log_base_scales, offsets, opacity, color, covariance = tensors
        m, k = offsets.shape[:2]
        means, quats, scales, colors = (positions.new_empty(m * k, width) for width in (3, 4, 3, 3))
        opacities, raw = positions.new_empty(m * k), positions.new_empty(m, k)
        ids = torch.empty(m * k, dtype=torch.int64, device=positions.device)
        library.call(
            "sgs_cuda_anchor_outputs",
            *(positions, log_offset_scales, log_base_scales, offsets, m, k, 1, opacity, color, covariance, seen),
            *(means, quats, scales, opacities, colors, raw, ids),
            device=positions.device,
        )
        ctx.library = library
        ctx.save_for_backward(log_offset_scales, log_base_scales, offsets, color, covariance, raw)
        ctx.mark_non_differentiable(raw, ids)
        return means, quats, scales, opacities, colors, raw, ids

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        log_offset_scales, log_base_scales, offsets, color, covariance, raw = ctx.saved_tensors
        m, k = offsets.shape[:2]
        # Gradients may be expanded, as those of a sum are.
        attributes = [gradient.contiguous() for gradient in gradients[:5]]
        found = [torch.empty_like(log_offset_scales) for _ in range(3)]
        v_offsets = torch.empty_like(offsets) if ctx.needs_input_grad[5] else None
        v_opacity, v_color, v_covariance = (torch.empty_like(value) for value in (raw, color, covariance))
        ctx.library.call(
            "sgs_cuda_anchor_outputs_backward",
            *(log_offset_scales, log_base_scales, offsets, m, k, color, covariance, raw),
            *(*attributes, *found, v_offsets, v_opacity, v_color, v_covariance),
            device=offsets.device,
        )
        return None, None, *found, v_offsets, v_opacity, v_color, v_covariance


def generate_structured(
    library: KernelLibrary,
    anchors: Anchors,
    mlps: MLPWeights,
    viewport: Viewport,
    *,
    distance_input: bool,
    tiles: TileSelection | None = None,
    sampling_intervals: Tensor | None = None,
) -> StructuredGaussians:
    """See ``reference_anchors.generate_structured``; float32. The host waits for the number of Gaussians.

    Raises:
        BackendError: a precision or device that the kernels do not support.
    """
    center = viewport.center.detach().contiguous()
    mask = None if tiles is None else tiles.mask.contiguous()
    given = (*anchors, viewport.viewmat, viewport.K, center, sampling_intervals)
    library.check_devices(*given, mask)
    if any(value is not None and value.dtype != torch.float32 for value in given):
        raise BackendError(
            "The cuda back-end generates float32 Gaussians; convert anchors and camera, or take another."
        )
    view = viewport._replace(viewmat=viewport.viewmat.contiguous(), K=viewport.K.contiguous())
    values = [value.contiguous() for value in anchors]
    camera = _KernelCamera(library, view, center, mask, sampling_intervals, distance_input)
    inputs, seen = _Inputs.apply(camera, *values)  # type: ignore[misc]
    outputs = [value.contiguous() for value in head_outputs(mlps, inputs)]
    means, quats, scales, opacities, colors, raw, ids = _Outputs.apply(library, seen, *values[:4], *outputs)  # type: ignore[misc]
    gaussians = Gaussians(means, quats, scales, opacities, colors, ids)
    drawn, visible = (opacities.detach() > 0).nonzero()[:, 0], seen.nonzero()[:, 0]
    return StructuredGaussians(gaussians.select(drawn), visible, raw[visible])


def generate_views(
    library: KernelLibrary,
    anchors: Anchors,
    mlps: MLPWeights,
    viewports: Sequence[Viewport],
    *,
    free: Gaussians,
    distance_input: bool,
    tiles: Sequence[TileSelection] | None = None,
    sampling_intervals: Tensor | None = None,
) -> list[Gaussians]:
    """See ``reference_views``: all ``M * K + F`` Gaussians in each view (Note [Shapes without waiting]); float32."""
    count, (m, k), d = len(viewports), anchors.offsets.shape[:2], anchors.features.shape[1]
    (width, height, near), device = viewports[0][3:], anchors.positions.device
    assert all(viewport[3:] == (width, height, near) for viewport in viewports), "views of one size and near plane"
    values = [value.detach().contiguous() for value in anchors]
    viewmats, Ks, centers = (torch.stack(column) for column in zip(*(view[:3] for view in viewports), strict=True))
    masks = None if tiles is None else torch.stack([of_view.mask for of_view in tiles])
    library.check_devices(*values, viewmats, Ks, centers, masks, sampling_intervals)
    inputs = torch.empty(count * m, d + 3 + distance_input, device=device)
    seen = torch.empty(count * m, dtype=torch.bool, device=device)
    library.call(
        "sgs_cuda_anchor_inputs",
        *(*values, sampling_intervals, m, k, d, int(distance_input), count, viewmats, Ks, centers),
        *(width, height, near, masks, inputs, seen),
        device=device,
    )
    outputs = [value.contiguous() for value in head_outputs(mlps, inputs)]
    means, quats, scales, colors = (torch.empty(count, m * k, width, device=device) for width in (3, 4, 3, 3))
    opacities, raw = torch.empty(count, m * k, device=device), torch.empty(count, m, k, device=device)
    ids = torch.empty(count, m * k, dtype=torch.int64, device=device)
    library.call(
        "sgs_cuda_anchor_outputs",
        *(*values[:4], m, k, count, *outputs, seen, means, quats, scales, opacities, colors, raw, ids),
        device=device,
    )
    columns = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors, "ids": ids}
    if sampling_intervals is not None:
        columns["sampling_intervals"] = sampling_intervals.repeat_interleave(k).expand(count, -1)
    if len(free):
        of_free = free.columns()
        columns = {
            name: torch.cat([rows, of_free[name].expand(count, *of_free[name].shape)], dim=1)
            for name, rows in columns.items()
        }
    return [Gaussians(**{name: rows[n] for name, rows in columns.items()}) for n in range(count)]
