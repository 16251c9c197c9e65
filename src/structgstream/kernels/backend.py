# SPDX-License-Identifier: Apache-2.0
"""Compute back-ends: each is a value with a name and one function per operation.

``reference`` is pure torch and runs anywhere, ``cpu`` is this package's C++, ``cuda`` wraps gsplat. A back-end without
its own implementation of an operation takes another's, stated where the value is built.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch

from structgstream.errors import BackendError
from structgstream.kernels.cuda_graph import GraphMemory, Recorder
from structgstream.kernels.cuda_tiles import PairBudget
from structgstream.kernels.operations import (
    L1SSIM,
    AdamStep,
    BlendingWeights,
    ChangeBits,
    ChangedPixels,
    ConfidentFlow,
    Excess,
    GenerateStructured,
    Lift,
    NeighbourDifference,
    PictureAndWeights,
    PictureResidual,
    PlaneScores,
    Rasterize,
    Sweep,
    Volume,
)

_log = logging.getLogger(__name__)

BackendName = Literal["auto", "cpu", "cuda", "reference"]


@dataclass(frozen=True)
class Backend:
    """The operations that rendering and training need; ``kernels.operations`` defines the contract of each.

    Args:
        name: ``reference``, ``cpu`` or ``cuda``.
        device: of its tensors.
        recorder: makes a recorder of iterations (``kernels.cuda_graph``); None where they are run one by one.
    """

    name: str
    device: torch.device
    rasterize: Rasterize
    blending_weights: BlendingWeights
    picture_and_weights: PictureAndWeights
    l1_ssim: L1SSIM
    volume: Volume
    excess: Excess
    neighbour_difference: NeighbourDifference
    change_bits: ChangeBits
    changed_pixels: ChangedPixels
    picture_residual: PictureResidual
    confident_flow: ConfidentFlow
    lift: Lift
    sweep: Sweep
    plane_scores: PlaneScores
    generate_structured: GenerateStructured
    adam_step: AdamStep
    recorder: Callable[[], Recorder[Any]] | None = None


def reference_backend() -> Backend:
    """Pure torch on the CPU: slow, always available, the oracle of the others."""
    from structgstream.kernels import (
        reference_adam,
        reference_anchors,
        reference_bits,
        reference_change,
        reference_excess,
        reference_flow,
        reference_lift,
        reference_neighbours,
        reference_planes,
        reference_raster,
        reference_residual,
        reference_ssim,
        reference_sweep,
        reference_volume,
    )

    return Backend(
        name="reference",
        device=torch.device("cpu"),
        rasterize=reference_raster.rasterize,
        blending_weights=partial(reference_raster.blending_weights, reference_raster.rasterize),
        picture_and_weights=partial(reference_raster.picture_and_weights, reference_raster.rasterize),
        l1_ssim=reference_ssim.l1_ssim,
        volume=reference_volume.volume,
        excess=reference_excess.excess,
        neighbour_difference=reference_neighbours.neighbour_difference,
        change_bits=reference_bits.change_bits,
        changed_pixels=reference_change.changed_pixels,
        picture_residual=reference_residual.picture_residual,
        confident_flow=reference_flow.confident_flow,
        lift=reference_lift.lift,
        sweep=reference_sweep.sweep,
        plane_scores=reference_planes.plane_scores,
        generate_structured=reference_anchors.generate_structured,
        adam_step=reference_adam.adam_step,
    )


def cpu_backend() -> Backend:
    """This package's C++ on the CPU.

    Raises:
        BackendError: the native library was not built or cannot be loaded.
    """
    from structgstream.kernels import (
        cpu_adam,
        cpu_anchors,
        cpu_bits,
        cpu_change,
        cpu_excess,
        cpu_flow,
        cpu_lift,
        cpu_neighbours,
        cpu_planes,
        cpu_raster,
        cpu_residual,
        cpu_ssim,
        cpu_sweep,
        cpu_volume,
    )
    from structgstream.kernels._load import native_library

    native_library()
    return Backend(
        name="cpu",
        device=torch.device("cpu"),
        rasterize=cpu_raster.rasterize,
        blending_weights=cpu_raster.blending_weights,
        picture_and_weights=cpu_raster.picture_and_weights,
        l1_ssim=cpu_ssim.l1_ssim,
        volume=cpu_volume.volume,
        excess=cpu_excess.excess,
        neighbour_difference=cpu_neighbours.neighbour_difference,
        change_bits=cpu_bits.change_bits,
        changed_pixels=cpu_change.changed_pixels,
        picture_residual=cpu_residual.picture_residual,
        confident_flow=cpu_flow.confident_flow,
        lift=cpu_lift.lift,
        sweep=cpu_sweep.sweep,
        plane_scores=cpu_planes.plane_scores,
        generate_structured=cpu_anchors.generate_structured,
        adam_step=cpu_adam.adam_step,
    )


def processor_backend() -> Backend:
    """The cpu back-end, or the reference where the native library was not built."""
    from structgstream.kernels._load import native_reason

    return cpu_backend() if native_reason() is None else reference_backend()


def cuda_backend() -> Backend:
    """gsplat's rasteriser, and this package's loss and generation of Gaussians on an NVIDIA GPU, torch for the rest.

    Raises:
        BackendError: no GPU, or gsplat is not installed or does not load.
    """
    from structgstream.kernels import (
        cuda_adam,
        cuda_generation,
        cuda_ssim,
        cuda_sweep,
        reference_anchors,
        reference_bits,
        reference_change,
        reference_excess,
        reference_lift,
        reference_neighbours,
        reference_raster,
        reference_residual,
        reference_ssim,
        reference_sweep,
        reference_volume,
    )
    from structgstream.kernels._nvcc import kernel_library
    from structgstream.kernels.cuda import cuda_reason, rasterize

    reason = cuda_reason()
    if reason is not None:
        raise BackendError(reason)
    processor = processor_backend()
    library, sentence = kernel_library()
    _log.log(logging.WARNING if library is None else logging.INFO, sentence)
    drawing = partial(rasterize, library=library)
    return Backend(
        name="cuda",
        device=torch.device("cuda"),
        rasterize=drawing,
        blending_weights=partial(reference_raster.blending_weights, drawing),
        picture_and_weights=partial(reference_raster.picture_and_weights, drawing),
        l1_ssim=reference_ssim.l1_ssim if library is None else partial(cuda_ssim.l1_ssim, library),
        volume=reference_volume.volume,
        excess=reference_excess.excess,
        neighbour_difference=reference_neighbours.neighbour_difference,
        change_bits=reference_bits.change_bits,
        changed_pixels=reference_change.changed_pixels,
        picture_residual=reference_residual.picture_residual,
        confident_flow=processor.confident_flow,
        lift=reference_lift.lift,
        sweep=reference_sweep.sweep if library is None else partial(cuda_sweep.sweep, library),
        plane_scores=processor.plane_scores,
        generate_structured=reference_anchors.generate_structured
        if library is None
        else partial(cuda_generation.generate_structured, library),
        adam_step=cuda_adam.adam_step,
        recorder=GraphMemory(torch.device("cuda")).recorder,
    )


def nonblocking(backend: Backend, budget: PairBudget) -> Backend:
    """The cuda back-end with shapes that do not depend on data, so that an iteration has no host synchronisation.

    ``generate_structured`` gives all Gaussians (``kernels.cuda_anchors``, Note [Shapes without waiting]); it and the
    tile lists run in this package's kernels if those were compiled, else in torch. A picture has
    at most ``budget.capacity`` (Gaussian, tile) pairs (``kernels.cuda_tiles``, Note [Pairs without waiting]); check
    ``budget.shortage()`` at the end.

    Raises:
        BackendError: ``backend`` is not the cuda one.
    """
    from structgstream.kernels import cuda_anchors, cuda_generation
    from structgstream.kernels._nvcc import kernel_library
    from structgstream.kernels.cuda import rasterize

    if backend.name != "cuda":
        raise BackendError(f"Only the cuda back-end runs asynchronously, not {backend.name}; use it as it is.")
    library, _ = kernel_library()
    return replace(
        backend,
        rasterize=partial(rasterize, budget=budget, library=library),
        generate_structured=cuda_anchors.generate_structured
        if library is None
        else partial(cuda_generation.generate_all, library),
    )


def backend_reasons() -> dict[str, str | None]:
    """For each back-end the reason why it is not available here; None if it is."""
    from structgstream.kernels._load import native_reason
    from structgstream.kernels.cuda import cuda_reason

    return {"cuda": cuda_reason(), "cpu": native_reason(), "reference": None}


def backend_remarks() -> dict[str, str]:
    """Remarks about available back-ends for the user: what computes the cuda back-end's own operations."""
    from structgstream.kernels._nvcc import kernel_plan

    return {"cuda": kernel_plan()[1]}


def select_backend(name: BackendName | Backend) -> Backend:
    """The back-end of that name; ``auto`` takes the first available of cuda, cpu, reference.

    Args:
        name: its name; a :class:`Backend` is returned as it is.

    Raises:
        BackendError: the named one is not available; the message states why and how to get it.
    """
    if isinstance(name, Backend):
        return name
    builders = {"cuda": cuda_backend, "cpu": cpu_backend, "reference": reference_backend}
    if name != "auto":
        return builders[name]()
    reasons = backend_reasons()
    if reasons["cuda"] is not None and reasons["cpu"] is not None:
        _log.warning("Running on the torch reference, which is many times slower. %s", reasons["cpu"])
    return next(builders[candidate]() for candidate in builders if reasons[candidate] is None)
