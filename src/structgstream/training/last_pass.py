# SPDX-License-Identifier: Apache-2.0
"""Loss and PSNR at the end of a fit, from the last rendering of each view."""

import math

import torch
from torch import Tensor

from structgstream.training.step import ViewLoss
from structgstream.training.views import View


class LastPass:
    """Mean loss terms and PSNR over the last pass through the views; tensors are read on access only.

    Args:
        after: number of first iterations to ignore.
        terms_after: the same for loss terms, where not every visit of a view has terms that can be compared.
    """

    def __init__(self, after: int = 0, *, terms_after: int | None = None) -> None:
        self._after, self._terms_after = after, after if terms_after is None else terms_after
        self._terms: dict[int, dict[str, Tensor]] = {}
        self._squared_errors: dict[int, Tensor] = {}

    def add(self, iteration: int, loss: ViewLoss, view: View, *, comparable: bool = True) -> None:
        """Record a view's result, replacing its earlier one; its loss terms only if they are ``comparable``."""
        if iteration > self._after:
            self._squared_errors[view.index] = loss.squared_error(view)
        if comparable and iteration > self._terms_after:
            # Copies: the next recorded iteration writes over the tensors of this one.
            self._terms[view.index] = {name: value.detach().clone() for name, value in loss.terms.items()}

    @property
    def psnr(self) -> float:
        """Mean over views of the PSNR in dB, NaN before any view."""
        values = [-10.0 * math.log10(max(float(error), 1e-10)) for error in self._squared_errors.values()]
        return sum(values) / len(values) if values else math.nan

    @property
    def terms(self) -> dict[str, float]:
        """Mean of each loss term."""
        names = dict.fromkeys(
            name for terms in self._terms.values() for name in terms
        )  # Not every view has every term.
        by_name = {name: [terms[name] for terms in self._terms.values() if name in terms] for name in names}
        return {name: float(torch.stack(values).mean()) for name, values in by_name.items()}
