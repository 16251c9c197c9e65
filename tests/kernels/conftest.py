# SPDX-License-Identifier: Apache-2.0
"""A machine that only says it has a GPU."""

from types import SimpleNamespace
from typing import Any

import pytest

from structgstream.kernels import cuda, cuda_library, self_check
from structgstream.kernels.cuda_library import CUDA_PROTOTYPES, KernelLibrary


@pytest.fixture
def pretended_gpu(monkeypatch: pytest.MonkeyPatch) -> KernelLibrary:
    """Kernels that do nothing, and agree with the processor."""
    functions: Any = SimpleNamespace(**{name: SimpleNamespace() for name in CUDA_PROTOTYPES})
    library = KernelLibrary(functions, "cuda", lambda device: 0)
    monkeypatch.setattr(cuda, "cuda_reason", lambda: None)
    monkeypatch.setattr(cuda_library, "kernel_library", lambda: library)
    monkeypatch.setattr(self_check, "disagreement", lambda rasterize, oracle, device: None)
    return library
