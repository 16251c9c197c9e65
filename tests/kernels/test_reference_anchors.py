# SPDX-License-Identifier: Apache-2.0
"""The generation beside the paper's equations in plain NumPy."""

import numpy as np
import torch

from structgstream.kernels.reference_anchors import activate_anchors
from structgstream.kernels.values import Anchors
from tests.support.rigs import random_scene


def generated(scene, center, visible):
    a = scene.anchors
    anchors = Anchors(a.positions, a.log_offset_scales, a.log_base_scales, a.offsets, a.features)
    return activate_anchors(anchors, scene.mlps, center, visible, distance_input=True)


def test_every_attribute_by_hand() -> None:
    scene, center = random_scene(12), torch.tensor([0.3, -0.2, -3.0])
    result = generated(scene, center, torch.arange(12)).gaussians
    a = {name: value.double().numpy() for name, value in vars(scene.anchors).items() if value is not None}

    def head(weights, x):
        w1, b1, w2, b2 = (w.double().numpy() for w in weights)
        return w2 @ np.maximum(w1 @ x + b1, 0) + b2

    rows = iter(range(len(result.ids)))
    for i in range(12):
        delta = a["positions"][i] - center.double().numpy()
        distance = np.linalg.norm(delta)
        x = np.concatenate([a["features"][i], delta / distance, [distance]])
        opacity = np.tanh(head(scene.mlps.opacity, x))
        color = 1 / (1 + np.exp(-head(scene.mlps.color, x))).reshape(5, 3)
        covariance = head(scene.mlps.covariance, x).reshape(5, 7)
        for j in range(5):
            if opacity[j] <= 0:
                continue
            row = next(rows)
            assert result.ids[row] == i * 5 + j
            mean = a["positions"][i] + a["offsets"][i, j] * np.exp(a["log_offset_scales"][i])
            scale = np.exp(a["log_base_scales"][i]) / (1 + np.exp(-covariance[j, :3]))
            quat = covariance[j, 3:] / np.linalg.norm(covariance[j, 3:])
            expected = (mean, scale, quat, opacity[j], color[j])
            got = (result.means, result.scales, result.quats, result.opacities, result.colors)
            for value, tensor in zip(expected, got):
                np.testing.assert_allclose(tensor[row].numpy(), value, rtol=2e-5, atol=2e-6)
    assert next(rows, None) is None


def test_only_visible_anchors_are_dressed() -> None:
    scene, center = random_scene(12), torch.zeros(3)
    visible = torch.tensor([1, 5, 11])
    result = generated(scene, center, visible)
    assert set((result.gaussians.ids // 5).tolist()) <= {1, 5, 11}
    assert result.raw_opacities.shape == (3, 5)
    assert len(generated(scene, center, visible[:0]).gaussians) == 0
