# SPDX-License-Identifier: Apache-2.0
"""The instruction sets that this machine can run the kernels on."""

from collections.abc import Iterator

import pytest

from structgstream.kernels._load import ISA_NAMES, native_library


@pytest.fixture(params=range(len(ISA_NAMES)), ids=ISA_NAMES)
def isa(request: pytest.FixtureRequest) -> Iterator[int]:
    """One run of the test for each instruction set."""
    library = native_library()
    if request.param > library.sgs_best_isa():
        pytest.skip(f"this processor or build has no {ISA_NAMES[request.param]}")
    library.sgs_use_isa(request.param)
    yield request.param
    library.sgs_use_isa(len(ISA_NAMES))
