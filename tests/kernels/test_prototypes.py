# SPDX-License-Identifier: Apache-2.0
"""The table of functions is the header's, and ctypes refuses calls with other arguments."""

import ctypes
import re
from pathlib import Path

import pytest

from structgstream.kernels._load import native_library, native_reason
from structgstream.kernels.prototypes import CUDA_PROTOTYPES, PROTOTYPES, TYPES

SOURCES = Path(__file__).parents[2] / "csrc"
HEADERS = {"structgstream.h": PROTOTYPES, "cuda": CUDA_PROTOTYPES}
FILES = {
    "structgstream.h": ["include/structgstream.h"],
    "cuda": ["cuda/ssim.h", "cuda/anchors.h", "cuda/sweep.h", "cuda/tiles.h"],
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


@pytest.mark.skipif(native_reason() is not None, reason="the native library is not built here")
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
