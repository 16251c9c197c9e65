# SPDX-License-Identifier: Apache-2.0
"""The functions of csrc/include/structgstream.h as ctypes must know them; a call with other arguments is refused.

A letter stands for a type of C: ``p`` any pointer, ``i`` int, ``l`` int64_t, ``f`` float, ``d`` double, ``v`` void.
"""

import ctypes
from collections.abc import Mapping

TYPES: Mapping[str, type | None] = {
    "p": ctypes.c_void_p,
    "i": ctypes.c_int,
    "l": ctypes.c_int64,
    "f": ctypes.c_float,
    "d": ctypes.c_double,
    "v": None,
}
PROTOTYPES: Mapping[str, tuple[str, str]] = {
    "sgs_abi_version": ("i", ""),
    "sgs_isa": ("i", ""),
    "sgs_best_isa": ("i", ""),
    "sgs_use_isa": ("i", "i"),
    "sgs_raster_forward": ("p", "lpppppppiifppplpppi"),
    "sgs_raster_weights": ("i", "lppppppiifpipi"),
    "sgs_raster_backward": ("i", "plppppppppppppppppi"),
    "sgs_raster_free": ("v", "p"),
    "sgs_l1_ssim": ("v", "pppiippppppi"),
    "sgs_l1_ssim_backward": ("v", "pppiippppffpi"),
    "sgs_changed_pixels": ("i", "ppiifipi"),
    "sgs_lift_flow": ("i", "ppppppppplliifpppi"),
    "sgs_sweep": ("v", "piippliifppi"),
    "sgs_anchors_visible": ("l", "plppiifppi"),
    "sgs_anchors_select": ("v", "ppi"),
    "sgs_anchors_dress": ("v", "pppi"),
    "sgs_anchors_backward": ("v", "pppppi"),
    "sgs_volume": ("d", "pplp"),
    "sgs_volume_backward": ("v", "plfp"),
    "sgs_excess": ("d", "ppllf"),
    "sgs_excess_backward": ("v", "ppllffpp"),
    "sgs_adam_step": ("v", "ppppplldldddi"),
    "sgs_rans_encode": ("i", "pplpliippp"),
    "sgs_rans_decode": ("i", "plpiplplip"),
    "sgs_code_activity": ("i", "pppilppp"),
    "sgs_code_residuals": ("i", "ppilippp"),
    "sgs_code_numbers": ("i", "ppilpip"),
}
"""By function: its result, and its arguments in order."""


def declare(library: ctypes.CDLL) -> None:
    """Tells ctypes the types of every function.

    Raises:
        AttributeError: the library lacks one.
    """
    for name, (result, arguments) in PROTOTYPES.items():
        function = getattr(library, name)
        function.restype = TYPES[result]
        function.argtypes = [TYPES[argument] for argument in arguments]
