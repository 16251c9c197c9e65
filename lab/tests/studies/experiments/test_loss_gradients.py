# SPDX-License-Identifier: Apache-2.0
"""The gradients that are compared are those of the printed sums and of everything but L_dist or L_vol."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from structgstream.kernels.backend import reference_backend
from structgstream.training.losses import InitialLossWeights, offset_distance, volume
from structgstream_studies.experiments.loss_gradients import compared

VOXEL = 0.1


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_ratios_are_those_of_the_printed_sum_whatever_is_trained(reduction: Any) -> None:
    offsets = torch.zeros(4, 5, 3)
    offsets[0, 0], offsets[1, 2, 1], offsets[2] = 0.5, -0.4, 0.19  # the last one is within 2 eps
    offsets.requires_grad_()
    anchors: Any = SimpleNamespace(offsets=offsets, log_offset_scales=torch.zeros(4, 3))
    weights = InitialLossWeights(
        offset_distance=0.01, offset_distance_reduction=reduction, volume=0.02, volume_reduction=reduction
    )
    backend = reference_backend()
    picture = (2.0 * offsets[:1]).sum() + (4.0 * offsets[1:]).sum()
    distance = offset_distance(anchors, voxel_size=VOXEL, weights=weights, backend=backend)
    scales, opacities = torch.tensor([[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]]).requires_grad_(), torch.tensor([0.5, 0.0])
    drawn_scales = torch.where(opacities[:, None] > 0, scales, 0.0)
    bulk = volume(drawn_scales, opacities, reduction=reduction, backend=backend)
    loss: Any = SimpleNamespace(
        total=picture + 4.0 * scales.sum() + weights.offset_distance * distance + weights.volume * bulk,
        structured=SimpleNamespace(
            anchors=torch.arange(3), gaussians=SimpleNamespace(opacities=opacities, scales=scales)
        ),
    )
    hooks = SimpleNamespace(
        parameters=SimpleNamespace(values={"anchor_offsets": offsets}),
        config=SimpleNamespace(losses=weights, voxel_size=VOXEL),
        scene=SimpleNamespace(anchors=_Sized(anchors)),
        backend=backend,
    )
    found = compared(hooks, loss)
    assert found["beyond"] == found["beyond_and_reached"] == 4
    assert found["median_ratio"] == pytest.approx(0.01 / 2.0)
    assert found["norm_ratio"] == pytest.approx(0.01 * 2.0 / (3 * 2.0**2 + 4.0**2) ** 0.5)
    assert (found["components"], found["anchors"], found["anchors_in_view"], found["drawn"]) == (60, 4, 3, 1)
    assert found["volume_median_ratio"] == pytest.approx(0.02 * 3.0 / 4.0)
    assert found["volume_norm_ratio"] == pytest.approx(0.02 * (6**2 + 3**2 + 2**2) ** 0.5 / (3 * 4.0**2) ** 0.5)
    assert found["excess_voxels"] == pytest.approx((3 * 0.3 + 0.2) / 4 / VOXEL, rel=1e-5)


class _Sized:
    def __init__(self, anchors: Any) -> None:
        self.offsets, self.log_offset_scales = anchors.offsets, anchors.log_offset_scales

    def __len__(self) -> int:
        return len(self.offsets)
