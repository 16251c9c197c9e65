# SPDX-License-Identifier: Apache-2.0
"""Dynamic appearance: anchor features may change after frame 0 along their first principal components.

In the paper f_v is static, and free Gaussians represent changes of appearance (lighting, folds, rotation). Coding all D
features of an anchor would cost more bits than its motion; R principal components cost a few bits.
"""

from dataclasses import replace

import torch

from structgstream.scene.scene import Scene


def with_appearance(scene: Scene, rank: int) -> Scene:
    """``scene`` with dynamic appearance along the first ``rank`` principal components of its features.

    The norm of a basis row is the features' standard deviation along it. The appearance starts at zero, which does not
    change renderings.
    """
    features = scene.anchors.features.double()
    centred = features - features.mean(0)
    variances, directions = torch.linalg.eigh(centred.T @ centred / max(len(features), 1))
    first = variances.argsort(descending=True)[:rank]
    rows = (directions[:, first] * variances[first].clamp(min=0.0).sqrt()).T
    # The sign of an eigenvector is arbitrary: its largest component is made positive.
    largest = rows.gather(1, rows.abs().argmax(1, keepdim=True))
    basis = torch.where(largest < 0, -rows, rows).to(scene.anchors.features)
    return replace(
        scene,
        anchors=replace(scene.anchors, appearance=basis.new_zeros(len(features), len(basis))),
        appearance_basis=basis.contiguous(),
    )
