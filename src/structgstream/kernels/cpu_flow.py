# SPDX-License-Identifier: Apache-2.0
"""Flow where it is consistent in this package's C++; the contract is ``kernels.operations.ConfidentFlow``."""

import torch
from torch import Tensor

from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses


def confident_flow(flow: Tensor, back: Tensor, mask: Tensor | None, *, relative: float, absolute: float) -> Tensor:
    """See ``kernels.operations.ConfidentFlow``."""
    assert flow.shape == back.shape, (flow.shape, back.shape)
    assert flow.dtype == back.dtype == torch.float32, (flow.dtype, back.dtype)
    flow, back = flow.contiguous(), back.contiguous()
    height, width = flow.shape[:2]
    counting = None if mask is None else mask.contiguous()
    maps = torch.empty(3, height, width)
    native_library().sgs_confident_flow(
        *addresses(flow, back),
        None if counting is None else counting.data_ptr(),
        height,
        width,
        relative,
        absolute,
        *addresses(maps),
        torch.get_num_threads(),
    )
    return maps
