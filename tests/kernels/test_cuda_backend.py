# SPDX-License-Identifier: Apache-2.0
"""What the cuda back-end is made of, on a machine that only says it has a GPU, and on one that has."""

import logging
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from structgstream.cli import doctor
from structgstream.errors import BackendError
from structgstream.kernels import backend, cuda, cuda_library, reference_anchors, reference_losses
from structgstream.kernels.cuda_library import CUDA_PROTOTYPES, KernelLibrary
from structgstream.kernels.cuda_tiles import PairBudget


@pytest.mark.parametrize("compiled", [True, False])
def test_own_operations_are_the_kernels_or_it_says_why_not(
    compiled: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    functions: Any = SimpleNamespace(**{name: SimpleNamespace() for name in CUDA_PROTOTYPES})
    library = KernelLibrary(functions, "cuda", lambda device: 0) if compiled else None
    monkeypatch.setattr(cuda, "cuda_reason", lambda **_: None)
    monkeypatch.setattr(cuda_library, "kernel_library", lambda: (library, "this is why"))
    with caplog.at_level(logging.INFO):
        found = backend.cuda_backend()
    assert found.name == "cuda"
    assert found.device == torch.device("cuda")
    assert found.recorder is not None
    assert backend.nonblocking(found, PairBudget.of(1, torch.device("cpu"))).recorder is found.recorder
    assert backend.reference_backend().recorder is None
    assert (found.l1_ssim is reference_losses.l1_ssim) is not compiled
    assert (found.generate_structured is reference_anchors.generate_structured) is not compiled
    assert [(record.levelno, record.getMessage()) for record in caplog.records] == [
        (logging.INFO if compiled else logging.WARNING, "this is why")
    ]


def test_without_compiled_kernels_native_iterations_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "cuda_reason", lambda **_: None)
    monkeypatch.setattr(cuda_library, "kernel_library", lambda: (None, "nvcc was not found."))
    with pytest.raises(BackendError, match=r"nvcc was not found\.$"):
        backend.cuda_backend(native=True)


def test_doctor_tells_what_the_loss_runs_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "backend_reasons", lambda: {"cuda": None, "cpu": None, "reference": None})
    monkeypatch.setattr(cuda_library, "find_nvcc", lambda environment: None)
    first = doctor.diagnose()["backends"][0]
    assert first["name"] == "cuda"
    assert first["advice"].startswith("L1, SSIM, anchors, sweeps and tile lists run in torch")
    assert "put nvcc on PATH" in first["advice"]
