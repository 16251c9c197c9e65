# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from structgstream.errors import CaptureError
from structgstream.kernels.values import HeadWeights
from structgstream.training.frame0.seeding import neighbor_distances, random_head, seeded_scene, voxel_centers


def seeded(points: torch.Tensor, **options):
    defaults = {
        "cameras": 3,
        "voxel_size": 0.1,
        "offsets_per_anchor": 5,
        "feature_width": 32,
        "hidden_width": 32,
        "distance_input": True,
        "device": torch.device("cpu"),
        "generator": torch.Generator().manual_seed(0),
    }
    return seeded_scene(points, **{**defaults, **options})


def drawn(head: HeadWeights, inputs: torch.Tensor) -> torch.Tensor:
    """Which Gaussians of anchors with these ``inputs`` of F_alpha have a positive opacity."""
    return torch.relu(inputs @ head.w1.T + head.b1) @ head.w2.T + head.b2 > 0


def test_one_anchor_a_voxel() -> None:
    points = torch.tensor([[0.01, 0.0, 0.0], [0.04, -0.04, 0.02], [0.09, 0.0, 0.0]])
    centers = voxel_centers(points, 0.1)
    assert torch.allclose(centers.sort(0).values, torch.tensor([[0.0, 0, 0], [0.1, 0, 0]]))


def test_scales_start_at_the_distance_to_three_neighbours() -> None:
    points = torch.rand(50, 3)
    squared = torch.cdist(points.double(), points.double()).square().sort(dim=1).values[:, 1:4].mean(1)
    assert torch.allclose(neighbor_distances(points).double(), squared.sqrt(), rtol=1e-5)


def test_the_start_is_neutral() -> None:
    scene = seeded(torch.rand(300, 3) * 2)
    assert (scene.anchors.offsets == 0).all()
    assert (scene.anchors.features == 0).all()
    assert torch.equal(scene.anchors.log_base_scales, scene.anchors.log_offset_scales)
    assert (scene.camera_color.gains == 1).all()
    assert scene.mlps.covariance.w2.shape == (35, 32)
    assert scene.mlps.opacity.w1.shape == (32, 36)
    assert seeded(torch.rand(300, 3), distance_input=False).mlps.opacity.w1.shape == (32, 35)


def test_every_gaussian_can_begin_drawn_whatever_camera_looks() -> None:
    points, shares = torch.rand(300, 3), {}
    for wanted in (False, True):
        heads = [
            seeded(points, all_drawn=wanted, generator=torch.Generator().manual_seed(n)).mlps.opacity for n in range(5)
        ]
        inputs = torch.cat([torch.zeros(64, 32), torch.randn(64, 4)], dim=1)
        shares[wanted] = [drawn(head, inputs).float().mean() for head in heads]
    assert min(shares[True]) == 1.0
    assert max(shares[False]) < 1.0, "as Scaffold-GS draws them, some begin transparent"


@pytest.mark.parametrize(("seed", "distance_input"), [(1000005, False), (98, True)])
def test_no_seed_begins_with_nothing_visible(seed: int, distance_input: bool, caplog: pytest.LogCaptureFixture) -> None:
    """With the first weights of these seeds no Gaussian has a positive opacity, so all anchors would be pruned."""
    directions = torch.nn.functional.normalize(torch.randn(64, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    inputs = torch.cat([torch.zeros(64, 32), directions, torch.ones(64, int(distance_input))], dim=1)
    generator = torch.Generator().manual_seed(seed)
    assert not drawn(random_head(35 + int(distance_input), 32, 5, generator), inputs).any()
    generator.manual_seed(seed)
    begun = seeded(torch.rand(100, 3), generator=generator, distance_input=distance_input)
    assert drawn(begun.mlps.opacity, inputs).any()
    assert "they are drawn again" in caplog.text


def test_the_seed_decides_the_weights() -> None:
    points = torch.rand(100, 3)
    assert torch.equal(seeded(points).mlps.color.w1, seeded(points).mlps.color.w1)
    other = seeded(points, generator=torch.Generator().manual_seed(1))
    assert not torch.equal(seeded(points).mlps.color.w1, other.mlps.color.w1)


def test_points_in_one_voxel_are_not_a_scene() -> None:
    with pytest.raises(CaptureError, match="at least 4"):
        seeded(torch.rand(100, 3) * 0.01)
