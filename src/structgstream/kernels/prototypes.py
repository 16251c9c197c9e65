# SPDX-License-Identifier: Apache-2.0
"""ctypes prototypes of the functions of csrc/include/structgstream.h and csrc/cuda/ssim.h.

With them ctypes converts plain numbers and addresses, and rejects a call with other arguments. A letter stands for a C
type: ``p`` any pointer, ``i`` int, ``l`` int64_t, ``f`` float, ``d`` double, ``v`` void, ``s`` a static string.
"""

import ctypes
from collections.abc import Mapping

from torch import Tensor

TYPES: Mapping[str, type | None] = {
    "p": ctypes.c_void_p,
    "i": ctypes.c_int,
    "l": ctypes.c_int64,
    "f": ctypes.c_float,
    "d": ctypes.c_double,
    "v": None,
    "s": ctypes.c_char_p,
}
PROTOTYPES: Mapping[str, tuple[str, str]] = {
    "sgs_abi_version": ("i", ""),
    "sgs_isa": ("i", ""),
    "sgs_best_isa": ("i", ""),
    "sgs_use_isa": ("i", "i"),
    "sgs_raster_forward": ("p", "lpppppppiifpppplpppi"),
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
    "sgs_adam_step": ("v", "ppppplldldddi"),
    "sgs_rans_encode": ("i", "pplpliippp"),
    "sgs_rans_decode": ("i", "plpiplplip"),
    "sgs_code_activity": ("i", "pppilppp"),
    "sgs_code_residuals": ("i", "ppilippp"),
    "sgs_code_numbers": ("i", "ppilpip"),
}
"""For each function of the CPU library: result type, argument types in order."""
CUDA_PROTOTYPES: Mapping[str, tuple[str, str]] = {
    "sgs_cuda_l1_ssim": ("i", "pppiippppppp"),
    "sgs_cuda_l1_ssim_backward": ("i", "pppiipppppppp"),
    "sgs_cuda_error": ("s", "i"),
    "sgs_cuda_anchor_inputs": ("i", "ppppppiiiipppiifpppp"),
    "sgs_cuda_anchor_inputs_backward": ("i", "piiipppp"),
    "sgs_cuda_anchor_outputs": ("i", "ppppiipppppppppppp"),
    "sgs_cuda_anchor_outputs_backward": ("i", "pppiipppppppppppppppp"),
    "sgs_cuda_sweep": ("i", "piippiiifpppp"),
    "sgs_cuda_tile_depths": ("i", "ppipp"),
    "sgs_cuda_tile_counts": ("i", "pppiiipp"),
    "sgs_cuda_tile_fill": ("i", "ppppiiilppp"),
    "sgs_cuda_tile_starts": ("i", "pppliippp"),
    "sgs_cuda_tile_reached": ("i", "ppipiipp"),
}
"""The same for the CUDA library."""


def declare(library: ctypes.CDLL, prototypes: Mapping[str, tuple[str, str]]) -> None:
    """Tells ctypes the types of every function.

    Raises:
        AttributeError: the library lacks one.
    """
    for name, (result, arguments) in prototypes.items():
        function = getattr(library, name)
        function.restype = TYPES[result]
        function.argtypes = [TYPES[argument] for argument in arguments]


def addresses(*tensors: Tensor | None) -> list[int | None]:
    """Where the numbers of each tensor lie; None, which is C's null, for one that is not there."""
    return [None if tensor is None else tensor.data_ptr() for tensor in tensors]
