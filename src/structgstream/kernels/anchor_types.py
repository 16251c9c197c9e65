# SPDX-License-Identifier: Apache-2.0
"""Arguments and result of generating structured Gaussians: anchors, MLP weights, Gaussians."""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from structgstream.gaussians import Gaussians


class Anchors(NamedTuple):
    """The anchor fields that the generation reads, ``M`` anchors.

    Args:
        positions: ``[M, 3]``, x_v.
        log_offset_scales: ``[M, 3]``, log l_v.
        log_base_scales: ``[M, 3]``, log of the largest Gaussian scale.
        offsets: ``[M, K, 3]``, O_v.
        features: ``[M, D]``, f_v.
    """

    positions: Tensor
    log_offset_scales: Tensor
    log_base_scales: Tensor
    offsets: Tensor
    features: Tensor


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
    """The Gaussians of the anchors in a camera's view.

    Args:
        gaussians: ascending by id, with unit quaternions. Rows of opacity 0 have scale 0 and are invisible; only
            back-ends with shapes that do not depend on data return such rows.
        anchors: ``[m]`` int64, ascending: the anchors that were evaluated, a superset of the visible ones.
        raw_opacities: ``[m, K]`` tanh outputs of these anchors, without a graph; positive ones are drawn.
    """

    gaussians: Gaussians
    anchors: Tensor
    raw_opacities: Tensor
