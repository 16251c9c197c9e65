# SPDX-License-Identifier: Apache-2.0
"""The back-ends that take part in whole fits."""

from dataclasses import replace

from structgstream.kernels.backend import Backend, cpu_backend, reference_backend


def torch_but_raster() -> Backend:
    """Torch for everything but the rasteriser, which is this package's C++: what a fit costs with one native kernel."""
    return replace(reference_backend(), rasterize=cpu_backend().rasterize)
