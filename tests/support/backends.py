# SPDX-License-Identifier: Apache-2.0
"""The back-end of tests that are about what is computed, not by whom."""

import pytest

from structgstream.kernels.backend import Backend, BackendName, cpu_backend, reference_backend, select_backend
from structgstream.kernels.native import native_reason

needs_native = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))
PROCESSOR = [pytest.param(reference_backend, id="reference"), pytest.param(cpu_backend, id="cpu", marks=needs_native)]
"""What builds each back-end of the processor."""
on_each_backend = pytest.mark.parametrize("build", PROCESSOR)

QUICKEST: BackendName = "cpu" if native_reason() is None else "reference"


def quickest_backend() -> Backend:
    """The native one, which takes a third to a tenth of the time; the reference where there is no native library."""
    return select_backend(QUICKEST)
