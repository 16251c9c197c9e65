# SPDX-License-Identifier: Apache-2.0
"""The loss on Gaussians' distances to their anchors in pure torch: the oracle."""

import torch
from torch import Tensor


def excess(offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor:
    """See ``kernels.operations.Excess``."""
    return torch.relu((offsets * log_scales.exp()[:, None]).abs() - limit).sum()
