# SPDX-License-Identifier: Apache-2.0
"""Adam (Kingma and Ba, 2015) in pure torch: the oracle of the optimiser step."""

from torch import Tensor


def adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float | Tensor,
    step: int | Tensor,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """See ``kernels.operations.AdamStep``."""
    lr, step = float(lr), int(step)
    exp_avg.mul_(betas[0]).add_(grad, alpha=1.0 - betas[0])
    exp_avg_sq.mul_(betas[1]).addcmul_(grad, grad, value=1.0 - betas[1])
    denominator = (exp_avg_sq / (1.0 - betas[1] ** step)).sqrt_().add_(eps)
    param.addcdiv_(exp_avg, denominator, value=-lr / (1.0 - betas[0] ** step))
