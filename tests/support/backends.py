# SPDX-License-Identifier: Apache-2.0
"""The back-end of tests that are about what is computed, not by whom."""

from structgstream.kernels.backend import Backend, BackendName, select_backend
from structgstream.kernels.native import native_reason

QUICKEST: BackendName = "cpu" if native_reason() is None else "reference"


def quickest_backend() -> Backend:
    """The native one, which takes a third to a tenth of the time; the reference where there is no native library."""
    return select_backend(QUICKEST)
