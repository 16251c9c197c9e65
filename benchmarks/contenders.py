# SPDX-License-Identifier: Apache-2.0
"""The back-ends that take part in whole fits."""

from structgstream.kernels.backend import Backend, cpu_backend, reference_backend


def torch_but_raster() -> Backend:
    """Torch for everything but the rasteriser, which is this package's C++: what a fit costs with one native kernel."""
    return reference_backend().with_functions(rasterize=cpu_backend().rasterize)
