# SPDX-License-Identifier: Apache-2.0
"""The weights of the three MLPs, and what generating structured Gaussians returns."""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor


class HeadWeights(NamedTuple):
    """One MLP with one hidden ReLU layer: ``w1 [hidden, inputs]``, ``b1``, ``w2 [outputs, hidden]``, ``b2``."""

    w1: Tensor
    b1: Tensor
    w2: Tensor
    b2: Tensor


class MLPWeights(NamedTuple):
    """The paper's F_alpha (K outputs, tanh), F_c (3K, sigmoid) and F_Sigma (7K, no activation)."""

    opacity: HeadWeights
    color: HeadWeights
    covariance: HeadWeights


@dataclass(frozen=True)
class StructuredGaussians:
    """Drawable Gaussians of the visible anchors, ascending by id.

    Args:
        means: ``[N, 3]``.
        quats: ``[N, 4]`` wxyz, unit length.
        scales: ``[N, 3]``.
        opacities: ``[N]`` in (0, 1).
        colors: ``[N, 3]``.
        ids: ``[N]`` int64, anchor * K + offset.
        raw_opacities: ``[m, K]`` tanh outputs of all ``m`` visible anchors, without a graph.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    ids: Tensor
    raw_opacities: Tensor
