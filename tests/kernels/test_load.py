# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.errors import BackendError
from structgstream.kernels import _load


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    _load._loaded.cache_clear()
    yield
    _load._loaded.cache_clear()


def test_a_missing_library_names_the_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(_load, "library_path", lambda: tmp_path / "nothing.so")
    assert "install a C++17 compiler" in str(_load.native_reason())
    with pytest.raises(BackendError, match="were not built"):
        _load.native_library()


def test_a_broken_library_says_what_the_loader_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "broken.so"
    broken.write_bytes(b"no library")
    monkeypatch.setattr(_load, "library_path", lambda: broken)
    assert "do not load" in str(_load.native_reason())


def test_the_instruction_set_has_a_name() -> None:
    if _load.native_reason() is None:
        assert _load.instruction_set() in _load.ISA_NAMES
