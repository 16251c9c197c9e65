# SPDX-License-Identifier: Apache-2.0
import hashlib
import re
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


class _Stale:
    """A library as it was before its interface had a version, or with another one."""

    def __init__(self, version: int | None) -> None:
        if version is not None:
            self.sgs_abi_version = lambda: version


@pytest.mark.parametrize("version", [None, _load.ABI_VERSION + 1])
def test_a_library_of_another_version_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, version: int | None
) -> None:
    stale = tmp_path / "stale.so"
    stale.write_bytes(b"")
    monkeypatch.setattr(_load, "library_path", lambda: stale)
    monkeypatch.setattr(_load.ctypes, "CDLL", lambda path: _Stale(version))
    reason = str(_load.native_reason())
    assert f"interface version {version or 0}," in reason
    assert "install structgstream again" in reason


def test_the_version_rises_with_the_interface() -> None:
    """When this fails the interface has changed: raise SGS_ABI_VERSION and ABI_VERSION, and note the new hash here."""
    sources = Path(__file__).parents[2] / "csrc"
    text = b"".join((sources / name).read_bytes() for name in ("include/structgstream.h", "cpu/anchors.h"))
    code = re.sub(rb"\s+", b" ", re.sub(rb"//[^\n]*|/\*.*?\*/", b"", text, flags=re.DOTALL))  # Comments may change.
    noted = {7: "1e09b66b40224ec33188e18aeb75151ac8b379177528f161747caadf008a1be3"}
    assert f"#define SGS_ABI_VERSION {_load.ABI_VERSION}\n".encode() in text
    assert hashlib.sha256(code).hexdigest() == noted[_load.ABI_VERSION]


def test_the_instruction_set_has_a_name() -> None:
    if _load.native_reason() is None:
        assert _load.instruction_set() in _load.ISA_NAMES
