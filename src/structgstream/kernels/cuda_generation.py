# SPDX-License-Identifier: Apache-2.0
"""Anchors to Gaussians on a GPU: this package's kernels around torch's matrix products.

An online iteration is bound by the host, which queues each operation: the same in torch (``kernels.cuda_anchors``) is
some 190 of them forward and 130 backward, and here some 30.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.cameras import Viewport
from structgstream.errors import BackendError
from structgstream.gaussians import Gaussians
from structgstream.kernels.anchor_types import Anchors, MLPWeights, StructuredGaussians
from structgstream.kernels.cuda_anchors import head_outputs
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.prototypes import addresses
from structgstream.kernels.raster_types import TileSelection


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
            *addresses(positions, log_offset_scales, log_base_scales, offsets, features, camera.intervals),
            *(m, k, d, int(camera.distance_input)),
            *addresses(view.viewmat, view.K, camera.center),
            *(view.width, view.height, view.near),
            *addresses(camera.tiles, inputs, seen),
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
                *addresses(positions),
                *(len(positions), d, int(camera.distance_input)),
                *addresses(camera.center, v_inputs, v_positions),
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
            *addresses(positions, log_offset_scales, log_base_scales, offsets),
            *(m, k),
            *addresses(opacity, color, covariance, seen, means, quats, scales, opacities, colors, raw, ids),
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
            *addresses(log_offset_scales, log_base_scales, offsets),
            *(m, k),
            *addresses(color, covariance, raw, *attributes, *found, v_offsets, v_opacity, v_color, v_covariance),
            device=offsets.device,
        )
        return None, None, *found, v_offsets, v_opacity, v_color, v_covariance


def generate_all(
    library: KernelLibrary,
    anchors: Anchors,
    mlps: MLPWeights,
    viewport: Viewport,
    *,
    distance_input: bool,
    tiles: TileSelection | None = None,
    seen_from: Tensor | None = None,
    sampling_intervals: Tensor | None = None,
) -> StructuredGaussians:
    """See ``kernels.operations.GenerateStructured``; float32. All ``N = M * K`` Gaussians, as
    ``kernels.cuda_anchors.generate_structured`` gives them, without host synchronisation.

    Raises:
        BackendError: a precision or device that the kernels do not support.
    """
    gaussians, _, raw = _generated(
        library, anchors, mlps, viewport, distance_input, tiles, seen_from, sampling_intervals
    )
    return StructuredGaussians(gaussians, torch.arange(len(raw), device=raw.device), raw)


def generate_structured(
    library: KernelLibrary,
    anchors: Anchors,
    mlps: MLPWeights,
    viewport: Viewport,
    *,
    distance_input: bool,
    tiles: TileSelection | None = None,
    seen_from: Tensor | None = None,
    sampling_intervals: Tensor | None = None,
) -> StructuredGaussians:
    """See ``kernels.operations.GenerateStructured``; float32. Those that are drawn, for whose number the host waits.

    Raises:
        BackendError: a precision or device that the kernels do not support.
    """
    gaussians, seen, raw = _generated(
        library, anchors, mlps, viewport, distance_input, tiles, seen_from, sampling_intervals
    )
    drawn, visible = (gaussians.opacities.detach() > 0).nonzero()[:, 0], seen.nonzero()[:, 0]
    return StructuredGaussians(gaussians.select(drawn), visible, raw[visible])


def _generated(
    library: KernelLibrary,
    anchors: Anchors,
    mlps: MLPWeights,
    viewport: Viewport,
    distance_input: bool,
    tiles: TileSelection | None,
    seen_from: Tensor | None,
    intervals: Tensor | None,
) -> tuple[Gaussians, Tensor, Tensor]:
    """All Gaussians, the mask ``[M]`` of the anchors that are seen, and the raw opacities ``[M, K]``."""
    center = (viewport.center if seen_from is None else seen_from).detach().contiguous()
    mask = None if tiles is None else tiles.mask.contiguous()
    library.check_devices(*anchors, viewport.viewmat, viewport.K, center, mask, intervals)
    numbers = [*anchors, viewport.viewmat, viewport.K, center, *([] if intervals is None else [intervals])]
    if any(value.dtype != torch.float32 for value in numbers):
        raise BackendError(
            "The cuda back-end generates float32 Gaussians; convert anchors and camera, or take another."
        )
    view = viewport._replace(viewmat=viewport.viewmat.contiguous(), K=viewport.K.contiguous())
    values = [value.contiguous() for value in anchors]
    inputs, seen = _Inputs.apply(_KernelCamera(library, view, center, mask, intervals, distance_input), *values)  # type: ignore[misc]
    outputs = [value.contiguous() for value in head_outputs(mlps, inputs)]
    means, quats, scales, opacities, colors, raw, ids = _Outputs.apply(library, seen, *values[:4], *outputs)  # type: ignore[misc]
    return Gaussians(means, quats, scales, opacities, colors, ids), seen, raw
