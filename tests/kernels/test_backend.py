# SPDX-License-Identifier: Apache-2.0
import logging

import pytest

from structgstream.errors import BackendError
from structgstream.kernels import backend, native


def test_the_reference_is_always_there() -> None:
    assert backend.backend_reasons()["reference"] is None
    assert backend.select_backend("reference").name == "reference"


def test_without_a_native_library_it_says_so_once_and_works(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(native, "_loaded", lambda: (None, "The CPU kernels were not built; install a compiler."))
    monkeypatch.setattr(backend, "backend_reasons", lambda: {"cuda": "no GPU", "cpu": "not built", "reference": None})
    with caplog.at_level(logging.WARNING):
        assert backend.select_backend("auto").name == "reference"
    assert [record.getMessage() for record in caplog.records] == [
        "Running on the torch reference, which is many times slower. not built"
    ]
    with pytest.raises(BackendError, match="install a compiler"):
        backend.select_backend("cpu")


def test_a_named_backend_that_is_missing_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def old_driver() -> None:
        raise RuntimeError("The NVIDIA driver on your system is too old (found version 11040). Please update your GPU")

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("torch.cuda.init", old_driver)
    with pytest.raises(BackendError, match=r"an NVIDIA GPU \(The NVIDIA driver .* \(found version 11040\)\);"):
        backend.select_backend("cuda")
