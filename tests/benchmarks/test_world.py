# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from benchmarks.world import HELD_OUT, held_out_psnr, moved, wall_rig, wall_scene, wall_world
from structgstream.kernels.backend import reference_backend


@pytest.mark.parametrize("share", [0.05, 0.4, 1.0])
def test_the_share_of_anchors_that_move_is_the_share_of_the_area(share: float) -> None:
    before = wall_scene(4000, cameras=2)
    after = moved(before, share=share, shift=(0.01, 0.0, 0.0))
    shifts = after.anchors.positions - before.anchors.positions
    assert (shifts[:, 0] > 0).float().mean() == pytest.approx(share, abs=0.02)
    assert torch.unique(shifts[:, 1:]).tolist() == [0.0]


def test_every_camera_sees_most_of_the_wall_and_one_is_held_out() -> None:
    rig, scene = wall_rig(5, width=48, height=36), wall_scene(500, cameras=5)
    assert rig.testing == (HELD_OUT,)
    assert len(rig.training) == 5
    for camera in (rig[name] for name in rig):
        points = scene.anchors.positions.double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = (points @ camera.K.T)[:, :2] / points[:, 2:]
        seen = ((pixels > 0) & (pixels < torch.tensor([camera.width, camera.height]))).all(1)
        assert seen.float().mean() > 0.6


def test_pictures_change_where_the_wall_moves_and_only_there() -> None:
    world = wall_world(reference_backend(), anchors=400, width=48, height=36, cameras=2, share=0.05, shift_pixels=2.0)
    changed = (world.previous.images[HELD_OUT] != world.frame.images[HELD_OUT]).any(axis=2)
    assert changed[18, 24]
    assert 0.02 < changed.mean() < 0.4
    assert not changed[:5].any()


def test_noise_is_added_to_training_pictures_only_and_quality_is_judged_without_it() -> None:
    backend = reference_backend()
    clean, noisy = (
        wall_world(backend, anchors=60, width=48, height=36, cameras=2, share=0.0, noise=noise) for noise in (0.0, 2.0)
    )
    name = clean.rig.training[0]
    difference = noisy.frame.images[name].astype(float) - clean.frame.images[name]
    assert 1.0 < difference.std() < 2.5
    assert np.array_equal(noisy.frame.images[HELD_OUT], clean.frame.images[HELD_OUT])
    assert held_out_psnr(noisy.before, noisy, backend) == 100.0


def test_a_finer_wall_is_dressed_alike() -> None:
    """Growth over anchors must not meet other MLPs: the share that is drawn stays."""
    rig, backend = wall_rig(2, width=48, height=36), reference_backend()
    shares = []
    for anchors in (500, 1000, 2000):
        scene = wall_scene(anchors, cameras=2)
        gaussians = scene.gaussians(rig[HELD_OUT], backend)
        shares.append(len(gaussians) / (5 * anchors))
        spacing = scene.anchors.log_offset_scales.exp().mean()
        assert (gaussians.scales.mean() / spacing).item() == pytest.approx(0.5, abs=0.15)
    assert 0.35 < min(shares) <= max(shares) < 0.65
    assert max(shares) - min(shares) < 0.05
