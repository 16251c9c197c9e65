# SPDX-License-Identifier: Apache-2.0
"""This package's C++ library: loads it once and declares its functions, or states why it cannot be loaded.

The declarations let ctypes convert plain numbers and reject calls with wrong arguments. A tensor is passed as the
address of its first element, so it must be contiguous.
"""

import ctypes
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from structgstream.errors import BackendError

ABI_VERSION = 11
"""Equal to the version in csrc/include/structgstream.h, which states when it is incremented."""
ISA_NAMES = ("baseline", "avx2", "avx512")
TYPES: Mapping[str, Any] = {
    "p": ctypes.c_void_p,
    "i": ctypes.c_int,
    "l": ctypes.c_int64,
    "f": ctypes.c_float,
    "d": ctypes.c_double,
    "v": None,
    "s": ctypes.c_char_p,
}
"""C types by letter: any pointer, int, int64_t, float, double, void, a static string."""
PROTOTYPES: Mapping[str, tuple[str, str]] = {
    "sgs_abi_version": ("i", ""),
    "sgs_isa": ("i", ""),
    "sgs_best_isa": ("i", ""),
    "sgs_use_isa": ("i", "i"),
    "sgs_raster_forward": ("p", "lpppppppiifpppplpppi"),
    "sgs_raster_radii": ("i", "lppppppiifppi"),
    "sgs_raster_weights": ("i", "lpppppppiifpppippi"),
    "sgs_raster_backward": ("i", "plppppppppppppppppi"),
    "sgs_raster_free": ("v", "p"),
    "sgs_l1_ssim": ("v", "pppiippppppi"),
    "sgs_l1_ssim_backward": ("v", "pppiippppffpi"),
    "sgs_changed_pixels": ("i", "ppiifipi"),
    "sgs_picture_residual": ("i", "pp"),
    "sgs_confident_flow": ("v", "pppiiffpi"),
    "sgs_lift_flow": ("i", "ppppppppplliifpppi"),
    "sgs_sweep": ("v", "piippliifppi"),
    "sgs_plane_scores": ("i", "piipiplifp"),
    "sgs_anchors_visible": ("l", "plpppiifppi"),
    "sgs_anchors_select": ("v", "ppi"),
    "sgs_anchors_dress": ("v", "pppi"),
    "sgs_anchors_backward": ("v", "pppppi"),
    "sgs_volume": ("d", "pplp"),
    "sgs_volume_backward": ("v", "plfp"),
    "sgs_excess": ("d", "ppllf"),
    "sgs_excess_backward": ("v", "ppllffpp"),
    "sgs_neighbour_difference": ("d", "pppllfp"),
    "sgs_change_bits": ("d", "pplfp"),
    "sgs_adam_step": ("v", "ppppldldddi"),
    "sgs_fit_new": ("p", "p"),
    "sgs_fit_run": ("i", "piii"),
    "sgs_fit_free": ("v", "p"),
    "sgs_rans_encode": ("i", "pplpliippp"),
    "sgs_rans_decode": ("i", "plpiplplip"),
    "sgs_code_activity": ("i", "pppilppp"),
    "sgs_code_residuals": ("i", "ppilippp"),
    "sgs_code_numbers": ("i", "ppilpip"),
}
"""For each function of csrc/include/structgstream.h: result type, argument types in order."""


class _Pointer:
    """The type of pointer arguments: a tensor, an address, a ctypes pointer, or None for null."""

    @staticmethod
    def from_param(value: Any) -> Any:
        return ctypes.c_void_p.from_param(value.data_ptr() if isinstance(value, Tensor) else value)


def declare(library: ctypes.CDLL, prototypes: Mapping[str, tuple[str, str]]) -> None:
    """Sets the types of every function.

    Raises:
        AttributeError: the library lacks a function.
    """
    for name, (result, arguments) in prototypes.items():
        function = getattr(library, name)
        function.restype = TYPES[result]
        function.argtypes = [_Pointer if argument == "p" else TYPES[argument] for argument in arguments]


def addresses(*tensors: Tensor | None) -> list[int | None]:
    """Address of each tensor's data, for the pointers of a C structure; None (null) for None."""
    return [None if tensor is None else tensor.data_ptr() for tensor in tensors]


OptionalTensor = TypeVar("OptionalTensor", bound=Tensor | None)


def constant(tensor: OptionalTensor) -> OptionalTensor:
    """The tensor as float32, contiguous, without gradient; None for None."""
    return None if tensor is None else tensor.detach().float().contiguous()  # type: ignore[return-value]


def members(of_type: Any, names: str) -> list[tuple[str, Any]]:
    """Members of one type for the ``_fields_`` of a C structure; ``names`` are separated by spaces."""
    return [(name, of_type) for name in names.split()]


def library_path() -> Path:
    """The path of the installed library."""
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


def instruction_set() -> str:
    """Name of the instruction set that the kernels use on this machine."""
    return ISA_NAMES[native_library().sgs_isa()]
