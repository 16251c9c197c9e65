# SPDX-License-Identifier: Apache-2.0
"""Optimiser steps of any back-end, from the same start."""

import torch
from torch import Tensor

OPTIONS = {"lr": 0.01, "betas": (0.9, 0.999), "eps": 1e-15}


def steps(module, param: Tensor, gradients: list[Tensor]) -> list[Tensor]:
    """The parameter and both moments after a step of ``module.adam_step`` for each gradient."""
    state = [param.clone(), torch.zeros_like(param), torch.zeros_like(param)]
    for n, gradient in enumerate(gradients, start=1):
        module.adam_step(state[0], gradient.to(param), state[1], state[2], step=n, **OPTIONS)
    return state
