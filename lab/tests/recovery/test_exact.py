# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import torch

from lab.recovery.exact import resampled_alike
from structgstream.cameras import Camera
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.prepared import PreparedCamera
from structgstream.data.timeline import Clock


def intrinsics(focal: float, across: float, down: float) -> torch.Tensor:
    return torch.tensor([[focal, 0, across], [0, focal, down], [0, 0, 1]], dtype=torch.float64)


def test_the_pinhole_of_a_true_camera_is_as_far_off_its_grid_as_the_recovered_one_is() -> None:
    camera = Camera(torch.eye(4, dtype=torch.float64), intrinsics(500.0, 240.4, 181.2), 480, 360, near=0.1)
    recovered = PreparedCamera(
        "videos/a.mp4", LensCamera(camera, Pinhole()), replace(camera, K=intrinsics(505.0, 240.4, 181.2)), Clock()
    )
    found = resampled_alike(intrinsics(496.0, 240.0, 180.0), recovered)
    torch.testing.assert_close(found, intrinsics(496.0 * 1.01, 240.0, 180.0))
