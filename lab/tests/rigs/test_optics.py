# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lab.rigs.filming import Filming
from lab.rigs.optics import LENSES, Refilmed, filmed_camera, normalised_subpixels
from lab.rigs.rig import base, bumped, corner_directions, fisheye, poses
from lab.rigs.variants import VARIANTS
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.undistortion import Undistortion

POSE = poses()["cam03"]
WIDE = base(POSE)


def seen(camera: LensCamera) -> NDArray[np.float32]:
    """A picture of waves that are fixed to directions, at the centres of pixels, from 0.1 to 0.9."""
    size = camera.camera
    pixels = np.stack(np.meshgrid(np.arange(size.width) + 0.5, np.arange(size.height) + 0.5), -1).astype(np.float64)
    x, y = np.moveaxis(camera.to_normalized(pixels), -1, 0)
    waves = [np.sin(40 * x + 9 * y), np.sin(33 * y - 12 * x), np.sin(25 * (x + y)) * np.sin(30 * x)]
    return (0.5 + 0.4 * np.stack(waves, -1)).astype(np.float32)


def psnr(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    return float(-10 * np.log10(np.mean((a.astype(np.float64) - b) ** 2)))


@pytest.mark.parametrize("lens", LENSES)
def test_a_refilmed_picture_is_what_the_lens_sees(lens: str) -> None:
    filmed = filmed_camera(WIDE, Filming(lens=lens, focal_factor=1.03, principal_offset=(5.0, -8.0)))
    assert psnr(Refilmed(WIDE, filmed)(seen(WIDE)), seen(filmed)) > 45


def test_undistorting_a_refilmed_picture_gives_the_pinhole_again() -> None:
    filmed = filmed_camera(WIDE, Filming(lens="phone"))
    K = torch.tensor([[640.0, 0, 240], [0, 640.0, 160], [0, 0, 1]], dtype=torch.float64)
    pinhole = replace(filmed.camera, K=K, width=480, height=320)
    direct = Refilmed(WIDE, LensCamera(pinhole, Pinhole()))(seen(WIDE))
    picture = (Refilmed(WIDE, filmed)(seen(WIDE)) * 255 + 0.5).astype(np.uint8)
    assert psnr(Undistortion(filmed, pinhole)(picture) / 255, direct) > 40


def test_a_lens_that_sees_more_than_was_traced_is_refused() -> None:
    with pytest.raises(ValueError, match="longer focal length"):
        Refilmed(WIDE, filmed_camera(WIDE, Filming(focal_factor=0.7)))(seen(WIDE))


@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.take == "table"])
def test_every_lens_of_every_rig_sees_only_what_is_traced(name: str) -> None:
    for filming in VARIANTS[name].cameras.values():
        filmed = filmed_camera(WIDE, filming)
        width, height = filmed.camera.width, filmed.camera.height
        across, down = np.linspace(0, width, 41), np.linspace(0, height, 31)
        border = np.concatenate(
            [np.stack([across, 0 * across + edge], -1) for edge in (0, height)]
            + [np.stack([0 * down + edge, down], -1) for edge in (0, width)]
        )
        found = WIDE.to_pixels(filmed.to_normalized(border))
        assert (found > 0).all(), name
        assert (found < [WIDE.camera.width, WIDE.camera.height]).all(), name


def test_directions_between_the_corners_of_a_pixel_are_exact_enough() -> None:
    filmed = filmed_camera(WIDE, Filming(lens="phone"))
    thirds = (np.arange(60) + 0.5) / 3  # the corner of the picture, where the lens bends most
    exact = filmed.to_normalized(np.stack(np.meshgrid(thirds, thirds), -1))
    close = normalised_subpixels(filmed)[:60, :60]
    assert np.abs(exact - close).max() * 600 < 1e-3  # pixels


@pytest.mark.parametrize("camera", [base(POSE), fisheye(POSE, seed=2)])
def test_rays_through_corners_meet_the_pixels_of_the_camera(camera: LensCamera) -> None:
    corners = corner_directions(camera).astype(np.float64)
    shown = (corners != 0).any(-1)
    down, across = np.nonzero(shown)
    chosen = np.random.default_rng(0).choice(len(down), 200, replace=False)
    points = camera.camera.center.numpy() + 2.5 * corners[down[chosen], across[chosen]]
    np.testing.assert_allclose(camera.pixels(points), np.stack([across, down], -1)[chosen], atol=2e-3)
    assert shown[camera.camera.height // 2].all()


def test_the_fisheye_shows_150_degrees_and_black_corners() -> None:
    camera = fisheye(POSE, seed=0)
    row = camera.to_normalized(np.array([[0.0, 330.0], [880.0, 330.0]]))
    assert np.rad2deg(np.arctan(np.abs(row[:, 0]))).sum() == pytest.approx(150, abs=1.5)
    assert not corner_directions(camera)[0, 0].any()


def test_cameras_stand_around_the_held_out_one_and_the_bumped_one_moves_little() -> None:
    centers = {name: -viewmat[:3, :3].T @ viewmat[:3, 3] for name, viewmat in poses().items()}
    middle = centers.pop("cam00")
    others = torch.stack(list(centers.values()))
    for axis in (0, 2):
        assert others[:, axis].min() < middle[axis] < others[:, axis].max()
    before, after = poses()["cam04"], bumped(poses()["cam04"])
    turn = after[:3, :3] @ before[:3, :3].T
    assert 0.5 < math.degrees(math.acos((float(turn.trace()) - 1) / 2)) < 1.5
    assert 0.005 < float((after.inverse() - before.inverse())[:3, 3].norm()) < 0.05
