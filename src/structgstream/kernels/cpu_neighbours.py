# SPDX-License-Identifier: Apache-2.0
"""How much rows differ from their neighbours in this package's C++; the contract is
``kernels.operations.NeighbourDifference``."""

from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses


class _NeighbourDifference(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, neighbours: Tensor, shares: Tensor, slack: float) -> Tensor:
        gradient = torch.zeros_like(values)
        total = native_library().sgs_neighbour_difference(
            *addresses(values, neighbours, shares), *neighbours.shape, slack, *addresses(gradient)
        )
        ctx.save_for_backward(gradient)
        return values.new_tensor(total)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        return ctx.saved_tensors[0] * gradients[0], None, None, None


def neighbour_difference(values: Tensor, neighbours: Tensor, shares: Tensor, *, slack: float) -> Tensor:
    """See ``kernels.operations.NeighbourDifference``.

    Raises:
        BackendError: another precision.
    """
    if values.dtype != torch.float32 or shares.dtype != torch.float32:
        raise BackendError(
            f"The cpu back-end compares float32 rows with their neighbours, not {values.dtype}; the reference back-end "
            "takes other precisions."
        )
    return _NeighbourDifference.apply(  # type: ignore[return-value]
        values.contiguous(), neighbours.contiguous(), shares.contiguous(), slack
    )
