# SPDX-License-Identifier: Apache-2.0
"""What an anchor's surface looks like may change after frame 0, in the few directions in which anchors differ.

The paper keeps f_v: a moving anchor keeps its looks, and what changes them (light, folds, another side) is left to
free Gaussians. All D features of an anchor would cost more than its motion; along their R main directions a change
costs a few bits.
"""

from dataclasses import replace

import torch

from structgstream.scene.scene import Scene


def with_appearance(scene: Scene, rank: int) -> Scene:
    """``scene`` with an appearance that may change along the first ``rank`` principal components of its features.

    A row of the basis is as long as the features' standard deviation along it. The scene looks as before.
    """
    features = scene.anchors.features.double()
    centred = features - features.mean(0)
    variances, directions = torch.linalg.eigh(centred.T @ centred / max(len(features), 1))
    first = variances.argsort(descending=True)[:rank]
    rows = (directions[:, first] * variances[first].clamp(min=0.0).sqrt()).T
    # An eigenvector has no sign of its own: its largest number is made positive.
    largest = rows.gather(1, rows.abs().argmax(1, keepdim=True))
    basis = torch.where(largest < 0, -rows, rows).to(scene.anchors.features)
    return replace(
        scene,
        anchors=replace(scene.anchors, appearance=basis.new_zeros(len(features), len(basis))),
        appearance_basis=basis.contiguous(),
    )
