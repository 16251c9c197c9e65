# SPDX-License-Identifier: Apache-2.0
"""Each term beside the paper's equation in plain NumPy."""

import numpy as np
import pytest
import torch

from structgstream.kernels.backend import reference_backend
from structgstream.training.losses import InitialLossWeights, offset_distance, volume
from tests.support.rigs import random_scene

BACKEND = reference_backend()


def test_volume_is_the_product_of_scales() -> None:
    scales = np.random.default_rng(0).uniform(0.1, 2.0, (11, 3))
    given, opacities = torch.from_numpy(scales), torch.full((11,), 0.1)
    total, mean = (volume(given, opacities, reduction=kind, backend=BACKEND).item() for kind in ("sum", "mean"))
    assert total == pytest.approx(scales.prod(1).sum())
    assert mean == pytest.approx(scales.prod(1).mean())


def test_what_is_not_drawn_does_not_count() -> None:
    scales, opacities = torch.full((4, 3), 2.0), torch.tensor([0.5, 0.0, 0.2, 0.0])
    scales[1] = scales[3] = 0.0
    assert volume(scales, opacities, reduction="mean", backend=BACKEND).item() == 8.0
    assert volume(0.0 * scales, 0.0 * opacities, reduction="mean", backend=BACKEND).item() == 0.0


def test_offset_distance_counts_what_is_beyond_two_voxels() -> None:
    anchors = random_scene().anchors
    offsets = anchors.offsets.double().numpy()
    scaled = offsets * np.exp(anchors.log_offset_scales.double().numpy())[:, None]
    length, eps = np.abs(scaled), 0.03
    expected = np.where(length - 2 * eps > 0, np.abs(length - 2 * eps), 0.0).sum()  # theta(O - 2 eps) ||O - 2 eps||
    weights = InitialLossWeights(offset_distance=1.0, offset_distance_reduction="sum")
    found = offset_distance(anchors, voxel_size=eps, weights=weights, backend=BACKEND)
    assert found.item() == pytest.approx(expected, rel=1e-5)
