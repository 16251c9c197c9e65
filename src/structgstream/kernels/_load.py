# SPDX-License-Identifier: Apache-2.0
"""Loads the native library once, and keeps the reason if it cannot be loaded."""

import ctypes
from functools import cache
from importlib.resources import files
from pathlib import Path

from structgstream.errors import BackendError
from structgstream.kernels.prototypes import PROTOTYPES, declare

ABI_VERSION = 7
"""As in csrc/include/structgstream.h, which states when it is incremented."""


def library_path() -> Path:
    """Where the library is installed."""
    return Path(str(files("structgstream") / "_native" / "libstructgstream.so"))


@cache
def _loaded() -> tuple[ctypes.CDLL | None, str | None]:
    path = library_path()
    if not path.is_file():
        return None, (
            "The CPU kernels were not built when structgstream was installed; install a C++17 compiler (for example "
            "g++) and install structgstream again."
        )
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        return None, f"The CPU kernels at {path} do not load ({error}); install structgstream again on this machine."
    version = library.sgs_abi_version() if hasattr(library, "sgs_abi_version") else 0
    if version != ABI_VERSION:
        return None, (
            f"The CPU kernels at {path} have interface version {version}, but this structgstream needs "
            f"version {ABI_VERSION}; install structgstream again."
        )
    declare(library, PROTOTYPES)
    return library, None


def native_reason() -> str | None:
    """Why the native library cannot be used and how to fix it; None if it can be used."""
    return _loaded()[1]


def native_library() -> ctypes.CDLL:
    """The native library.

    Raises:
        BackendError: it is missing or does not load.
    """
    library, reason = _loaded()
    if library is None:
        raise BackendError(str(reason))
    return library


ISA_NAMES = ("baseline", "avx2", "avx512")


def instruction_set() -> str:
    """Name of the instruction set that the kernels use on this machine."""
    return ISA_NAMES[native_library().sgs_isa()]
