# SPDX-License-Identifier: Apache-2.0
"""The native library is loaded or a reason given; its prototypes are those of the headers."""

import ctypes
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.errors import BackendError
from structgstream.kernels import native
from structgstream.kernels.cuda_library import CUDA_PROTOTYPES
from structgstream.kernels.native import PROTOTYPES, TYPES, native_library
from tests.support.backends import needs_native

SOURCES = Path(__file__).parents[2] / "csrc"


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    native._loaded.cache_clear()
    yield
    native._loaded.cache_clear()


def test_a_missing_library_names_the_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(native, "library_path", lambda: tmp_path / "nothing.so")
    assert "install a C++17 compiler" in str(native.native_reason())
    with pytest.raises(BackendError, match="were not built"):
        native.native_library()


def test_a_broken_library_says_what_the_loader_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "broken.so"
    broken.write_bytes(b"no library")
    monkeypatch.setattr(native, "library_path", lambda: broken)
    assert "do not load" in str(native.native_reason())


class _Stale:
    """A library as it was before its interface had a version, or with another one."""

    def __init__(self, version: int | None) -> None:
        if version is not None:
            self.sgs_abi_version = lambda: version


@pytest.mark.parametrize("version", [None, native.ABI_VERSION + 1])
def test_a_library_of_another_version_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, version: int | None
) -> None:
    stale = tmp_path / "stale.so"
    stale.write_bytes(b"")
    monkeypatch.setattr(native, "library_path", lambda: stale)
    monkeypatch.setattr(native.ctypes, "CDLL", lambda path: _Stale(version))
    reason = str(native.native_reason())
    assert f"interface version {version or 0}," in reason
    assert "install structgstream again" in reason


def test_the_version_rises_with_the_interface() -> None:
    """When this fails the interface has changed: raise SGS_ABI_VERSION and ABI_VERSION, and note the new hash here."""
    text = b"".join((SOURCES / name).read_bytes() for name in ("include/structgstream.h", "cpu/anchors.h"))
    code = re.sub(rb"\s+", b" ", re.sub(rb"//[^\n]*|/\*.*?\*/", b"", text, flags=re.DOTALL))  # Comments may change.
    noted = {11: "7c5f03bffe9859a2e8b7cfe750bd9b5eb328951b6c6238e54c0db2fe5a3338cd"}
    assert f"#define SGS_ABI_VERSION {native.ABI_VERSION}\n".encode() in text
    assert hashlib.sha256(code).hexdigest() == noted[native.ABI_VERSION]


def test_the_instruction_set_has_a_name() -> None:
    if native.native_reason() is None:
        assert native.instruction_set() in native.ISA_NAMES


HEADERS = {"structgstream.h": PROTOTYPES, "cuda": CUDA_PROTOTYPES}
FILES = {
    "structgstream.h": ["include/structgstream.h"],
    "cuda": [f"cuda/{name}.h" for name in ("anchors", "fit", "lift", "picture", "ssim", "sweep")],
}
LETTERS = {"int": "i", "int64_t": "l", "float": "f", "double": "d", "void": "v"}


def letter(declaration: str) -> str:
    """The letter of a C type, with or without the name of an argument."""
    if declaration.strip() == "const char*":
        return "s"
    return "p" if "*" in declaration else LETTERS[declaration.replace("const", "").split()[0]]


def code_of(header: str) -> str:
    """Without its comments."""
    text = "".join((SOURCES / name).read_text() for name in FILES[header])
    return re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)


def declared(header: str) -> dict[str, tuple[str, str]]:
    """What the header says, read by its text alone."""
    text = code_of(header)
    found = re.findall(r"^(\w[\w ]*[ *]+)(sgs_\w+)\(([^)]*)\);", text, flags=re.MULTILINE)
    return {
        name: (letter(result), "" if given.strip() == "void" else "".join(map(letter, given.split(","))))
        for result, name, given in found
    }


@pytest.mark.parametrize("header", HEADERS)
def test_the_table_is_the_header_s(header: str) -> None:
    found = declared(header)
    assert len(found) > 2
    assert found.keys() == {*re.findall(r"\b(sgs_\w+)\(", code_of(header))}
    assert found == HEADERS[header]
    assert TYPES.keys() == {*LETTERS.values(), "p", "s"}


@needs_native
def test_a_call_with_other_arguments_is_refused() -> None:
    library = native_library()
    for name, (_, arguments) in PROTOTYPES.items():
        assert len(getattr(library, name).argtypes) == len(arguments)
    scales, drawn = (ctypes.c_float * 3)(2.0, 3.0, 4.0), ctypes.c_int64()
    opacities = (ctypes.c_float * 1)(1.0)
    assert library.sgs_volume(scales, opacities, 1, ctypes.byref(drawn)) == 24.0
    assert drawn.value == 1
    with pytest.raises(ctypes.ArgumentError):
        library.sgs_volume(scales, opacities, 1.0, ctypes.byref(drawn))
    with pytest.raises(ctypes.ArgumentError):
        library.sgs_volume(scales, opacities, ctypes.c_int(1), ctypes.byref(drawn))
    with pytest.raises(TypeError):
        library.sgs_volume(scales, opacities, 1)
