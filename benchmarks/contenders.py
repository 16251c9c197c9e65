# SPDX-License-Identifier: Apache-2.0
"""The back-ends that take part in whole fits."""

from structgstream.kernels.backend import Backend, cpu_backend, reference_backend


def contenders() -> list[tuple[str, Backend, int]]:
    """Name, back-end and threads: first torch for everything but the rasteriser, which is this package's C++, then the
    C++ with one and with two threads. The first is what a fit costs with one native kernel."""
    native = cpu_backend()
    return [
        ("torch but the raster, 2 threads", reference_backend().with_functions(rasterize=native.rasterize), 2),
        ("cpu, 1 thread", native, 1),
        ("cpu, 2 threads", native, 2),
    ]
