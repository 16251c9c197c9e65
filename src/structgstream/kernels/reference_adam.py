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
    rows: Tensor | None = None,
) -> None:
    """See ``kernels.operations.AdamStep``."""
    if rows is not None:
        values = [tensor[rows] for tensor in (param, grad, exp_avg, exp_avg_sq)]
        adam_step(*values, lr=lr, step=step, betas=betas, eps=eps)
        for tensor, value in zip((param, exp_avg, exp_avg_sq), (values[0], values[2], values[3])):
            tensor[rows] = value
        return
    lr, step = float(lr), int(step)
    exp_avg.mul_(betas[0]).add_(grad, alpha=1.0 - betas[0])
    exp_avg_sq.mul_(betas[1]).addcmul_(grad, grad, value=1.0 - betas[1])
    denominator = (exp_avg_sq / (1.0 - betas[1] ** step)).sqrt_().add_(eps)
    param.addcdiv_(exp_avg, denominator, value=-lr / (1.0 - betas[0] ** step))
