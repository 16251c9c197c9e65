# SPDX-License-Identifier: Apache-2.0
"""Anchors and the weights of the three MLPs, and what generating structured Gaussians returns."""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from structgstream.gaussians import Gaussians


class Anchors(NamedTuple):
    """What the generation reads of ``M`` anchors.

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
    """The Gaussians of the anchors that a camera may see.

    Args:
        gaussians: ascending by id, their quaternions of unit length. What has opacity 0 has scale 0 too and shows
            nowhere; only back-ends that wait for no count have such rows.
        anchors: ``[m]`` int64, ascending: those that were looked at, among them all that may show.
        raw_opacities: ``[m, K]`` tanh outputs of these anchors, without a graph; a Gaussian is drawn where it is
            positive.
    """

    gaussians: Gaussians
    anchors: Tensor
    raw_opacities: Tensor
