# SPDX-License-Identifier: Apache-2.0
"""Compute back-ends: the table of their operations, and the function of each back-end for each of them.

``reference`` is pure torch and runs anywhere, ``cpu`` is this package's C++, ``cuda`` is this package's CUDA kernels.
An operation is defined by its function in ``reference_*``: the signature, the contract, and the results that
parity tests compare other back-ends with.

Note [Ownership]
~~~~~~~~~~~~~~~~
The same on every back-end:

- Arguments are neither changed nor aliased by results, with two exceptions. ``rasterize`` draws into ``onto`` in place:
  the returned ``image`` shares its memory, so the next drawing into it changes both. ``adam_step`` updates ``param``
  and its two moments in place.
- Results belong to the caller.
- Cameras, targets, masks and numbers get no gradient; every other tensor gets one if it requires it. ``ids``,
  ``anchors``, ``raw_opacities`` and ``radii`` of results have no graph.
- Indices are int64 and ascending, masks bool.
- A kernel without enough memory raises ``OutOfMemoryError``. Tensors that a back-end does not support raise
  ``BackendError``, which names a back-end that supports them.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import Any, Generic, Literal, ParamSpec, TypeVar, overload

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels import reference_anchors, reference_losses, reference_motion, reference_raster
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.reference_views import ORACLE, ViewByView
from structgstream.kernels.values import FitFrame

_log = logging.getLogger(__name__)

BackendName = Literal["auto", "cpu", "cuda", "reference"]
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


class Operation(Generic[Parameters, Result]):
    """A row of the table in :class:`Backend`. As an attribute of a back-end it is the function of that back-end.

    Args:
        oracle: the pure-torch function that defines the operation.
    """

    def __init__(self, oracle: Callable[Parameters, Result]) -> None:
        self.oracle = oracle
        self.name = oracle.__name__

    @overload
    def __get__(self, backend: None, owner: type) -> "Operation[Parameters, Result]": ...
    @overload
    def __get__(self, backend: "Backend", owner: type) -> Callable[Parameters, Result]: ...
    def __get__(self, backend: "Backend | None", owner: type) -> Any:
        return self if backend is None else backend.functions[self.name]


@dataclass(frozen=True, eq=False)
class Backend:
    """The operations that rendering and training need, and how one back-end computes them.

    Unless a comment states otherwise, the cpu back-end has a C++ function for each, and the cuda back-end runs the
    reference's.

    Args:
        name: ``reference``, ``cpu`` or ``cuda``.
        device: device of its tensors.
        functions: function of each operation by name, with the signature of the oracle.
        iterations: runs those of a frame in which only anchors and free Gaussians are trained (``kernels.cpu_fit``,
            ``kernels.cuda_fit``); None: they are run in torch.
    """

    name: str
    device: torch.device
    functions: Mapping[str, Callable[..., Any]]
    iterations: Callable[[FitFrame], Callable[[int, int], None]] | None = None

    rasterize = Operation(reference_raster.rasterize)  # cuda: own kernels; as the eight below
    display = Operation(reference_raster.display)  # cpu: the reference's function
    generate_views = Operation(ORACLE.generate_views)
    draw_views = Operation(ORACLE.draw_views)
    weigh_views = Operation(ORACLE.weigh_views)
    draw_and_weigh_views = Operation(ORACLE.draw_and_weigh_views)
    reached_tiles = Operation(ORACLE.reached_tiles)
    generate_structured = Operation(reference_anchors.generate_structured)
    l1_ssim = Operation(reference_losses.l1_ssim)
    volume = Operation(reference_losses.volume)
    excess = Operation(reference_losses.excess)
    neighbour_difference = Operation(reference_losses.neighbour_difference)
    change_bits = Operation(reference_losses.change_bits)
    adam_step = Operation(reference_losses.adam_step)  # cuda: torch's fused kernel
    changed_pixels = Operation(reference_motion.changed_pixels)
    picture_residuals = Operation(reference_motion.picture_residuals)
    confident_flow = Operation(reference_motion.confident_flow)  # cuda: on the CPU, where flow is estimated
    lift = Operation(reference_motion.lift)  # cuda: own kernel
    sweep = Operation(reference_motion.sweep)  # cuda: own kernels
    plane_scores = Operation(reference_motion.plane_scores)  # cuda: on the CPU

    def __post_init__(self) -> None:
        assert self.functions.keys() == self.operations().keys(), self.functions.keys() ^ self.operations().keys()

    @classmethod
    def operations(cls) -> dict[str, Operation[..., Any]]:
        """The table: every operation by its name."""
        return {name: row for name, row in vars(cls).items() if isinstance(row, Operation)}

    def with_functions(self, **functions: Callable[..., Any]) -> "Backend":
        """This back-end with other functions for the operations named."""
        return replace(self, functions={**self.functions, **functions})


def functions_of(*modules: ModuleType | ViewByView) -> dict[str, Callable[..., Any]]:
    """The functions that have the name of an operation."""
    return {name: getattr(module, name) for module in modules for name in Backend.operations() if hasattr(module, name)}


def reference_backend() -> Backend:
    """Pure torch on the CPU: slow, always available, the oracle of the other back-ends."""
    return Backend("reference", torch.device("cpu"), {name: row.oracle for name, row in Backend.operations().items()})


def cpu_backend() -> Backend:
    """This package's C++ on the CPU.

    Raises:
        BackendError: the native library was not built or cannot be loaded.
    """
    from structgstream.kernels import cpu_anchors, cpu_fit, cpu_losses, cpu_motion, cpu_raster
    from structgstream.kernels.native import native_library

    native_library()
    functions = functions_of(cpu_raster, cpu_anchors, cpu_losses, cpu_motion)
    views = ViewByView(
        cpu_anchors.generate_structured,
        cpu_raster.rasterize,
        cpu_raster.projected_radii,
        cpu_raster.blending_weights,
        cpu_raster.picture_and_weights,
    )
    functions |= functions_of(views) | {"display": reference_raster.display}
    return Backend("cpu", torch.device("cpu"), functions, iterations=cpu_fit.iterations)


def processor_backend() -> Backend:
    """The cpu back-end, or the reference where the native library was not built."""
    from structgstream.kernels.native import native_reason

    return cpu_backend() if native_reason() is None else reference_backend()


def cuda_backend() -> Backend:
    """An NVIDIA GPU: this package's kernels, from the wheel or compiled on first use, and torch for the rest.

    Raises:
        BackendError: there is no GPU, there are neither kernels for it nor a compiler, the kernels do not compile or
            load, or their pictures differ from those of the CPU.
    """
    from structgstream.kernels import cuda, cuda_fit, cuda_library
    from structgstream.kernels.self_check import disagreement

    reason = cuda.cuda_reason()
    if reason is not None:
        raise BackendError(reason)
    library, processor = cuda_library.kernel_library(), processor_backend()
    backend = replace(
        reference_backend(),
        name="cuda",
        device=torch.device("cuda"),
        iterations=partial(cuda_fit.iterations, library),
    ).with_functions(
        **kernel_functions(library),
        confident_flow=processor.confident_flow,
        plane_scores=processor.plane_scores,
    )
    if differs := disagreement(backend.rasterize, processor.rasterize, backend.device):
        raise BackendError(
            f"The GPU's kernels draw otherwise than the processor: {differs}. Use --device cpu, and report it with "
            "what structgstream doctor prints."
        )
    return backend


def kernel_functions(library: KernelLibrary) -> dict[str, Callable[..., Any]]:
    """The cuda back-end's own functions: those of the kernels, and ``adam_step``, which is torch's fused kernel."""
    from structgstream.kernels import cuda, cuda_anchors, cuda_picture

    functions = functions_of(cuda_picture, cuda_anchors, cuda)
    adam_step = functions.pop("adam_step")
    return {**{name: partial(function, library) for name, function in functions.items()}, "adam_step": adam_step}


def on_processor(*tensors: Tensor) -> list[Tensor]:
    """Copies of ``tensors`` on the CPU, with one synchronisation for all; tensors already there are not copied."""
    copies = [tensor.to("cpu", non_blocking=True) for tensor in tensors]
    wait_for(tensors[0].device)
    return copies


def wait_for(device: torch.device) -> None:
    """Waits until ``device`` has finished everything that was queued."""
    if device.type == "cuda":
        torch.cuda.current_stream(device).synchronize()


def backend_reasons() -> dict[str, str | None]:
    """For each back-end the reason why it is not available here; None if it is."""
    from structgstream.kernels.cuda import cuda_reason
    from structgstream.kernels.native import native_reason

    return {"cuda": cuda_reason(), "cpu": native_reason(), "reference": None}


def select_backend(name: BackendName | Backend) -> Backend:
    """The back-end of that name; ``auto`` takes the first available of cuda, cpu, reference.

    Args:
        name: its name; a :class:`Backend` is returned as it is.

    Raises:
        BackendError: the named one does not exist or is not available; the message states why and how to get it.
    """
    if isinstance(name, Backend):
        return name
    builders = {"cuda": cuda_backend, "cpu": cpu_backend, "reference": reference_backend}
    if name != "auto":
        if name not in builders:
            raise BackendError(f"There is no back-end {name!r}; there are auto, {', '.join(builders)}.")
        return builders[name]()
    reasons = backend_reasons()
    if reasons["cuda"] is not None and reasons["cpu"] is not None:
        _log.warning("Running on the torch reference, which is many times slower. %s", reasons["cpu"])
    return next(builders[candidate]() for candidate in builders if reasons[candidate] is None)
