# SPDX-License-Identifier: Apache-2.0
"""Iterations of a frame on a GPU in this package's kernels, without Python between them (csrc/cuda/fit_calls.h)."""

import ctypes
import weakref
from collections.abc import Callable

from structgstream.kernels.cpu_fit import native_frame
from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.values import FitFrame

SLOTS_PER_GAUSSIAN = 16
"""Places for the gradients of pairs of a Gaussian and a tile; more are made when an iteration needs them."""


def iterations(library: KernelLibrary, frame: FitFrame, *, slots: int | None = None) -> Callable[[int, int], None]:
    """See ``cpu_fit.iterations``; results repeat bit for bit. This and each call of the function wait once for the GPU.

    Args:
        library: the kernels.
        frame: leaves, pictures and weights on the GPU; ``order``, ``rests``, ``rates`` and results of its plan in
            the memory of the host.
        slots: at first; None: by the number of Gaussians.

    Raises:
        OutOfMemoryError: the GPU has no memory for what an iteration needs, here or in the function.
        BackendError: CUDA reports another error.
    """
    positions, offsets, means = (frame.leaves[n] for n in (0, 3, 6))
    assert positions
    assert offsets
    assert means
    plan = frame.plan
    library.check_devices(*(leaf.values for leaf in frame.leaves if leaf), *(view.picture for view in frame.views))
    assert all(t.device.type == "cpu" for t in (plan.order, plan.rests, plan.rates, plan.terms, plan.squared_errors))
    native, alive = native_frame(frame)
    gaussians = len(positions.values) * offsets.values.shape[1] + len(means.values)
    functions, fit = library.library, ctypes.c_void_p()
    stream = library.stream(positions.values.device)

    error = functions.sgs_cuda_fit_new(
        ctypes.byref(native), slots or SLOTS_PER_GAUSSIAN * gaussians, stream, ctypes.byref(fit)
    )

    def run(first: int, last: int) -> None:
        assert alive
        library.check(functions.sgs_cuda_fit_run(fit, first, last))

    weakref.finalize(run, functions.sgs_cuda_fit_free, fit)
    library.check(error)
    return run
