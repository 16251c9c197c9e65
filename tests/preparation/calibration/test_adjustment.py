# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import torch

from structgstream.cameras import Camera
from structgstream.data.calibration import rotation_matrix
from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.preparation.calibration.bundle import adjust_together, cleaned
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DISTORTION, DOWN, FOCAL
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
from tests.support.calibration_errors import calibration_errors

CAMERAS, POINTS = 9, 300
FREE = (FOCAL, ASPECT, ACROSS, DOWN, *DISTORTION["brown"])


def rig() -> tuple[SolvedCalibration, np.ndarray]:
    """Phones of one model on an arc, whose principal points lie 9 pixels aside; some observations are wrong."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (POINTS, 3))
    cameras = {}
    for index, angle in enumerate(np.linspace(-0.7, 0.7, CAMERAS)):
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation_matrix(np.array([0.25 * np.sin(3 * index), angle, 0.05 * np.cos(index)]))
        viewmat[:3, 3] = [0.1 * np.sin(index), 0.1 * np.cos(index), 3.4]
        focal = 600 * rng.uniform(0.98, 1.02)
        across, down = np.array([327, 246]) + rng.normal(0, 1.5, 2)
        K = torch.tensor([[focal, 0, across], [0, focal, down], [0, 0, 1]], dtype=torch.float64)
        lens = RadialTangential(k1=0.2, k2=-0.8, k3=0.8)
        cameras[f"cam{index}"] = LensCamera(Camera(torch.from_numpy(viewmat), K, 640, 480), lens)
    pixels = np.stack([filmed.pixels(points) for filmed in cameras.values()])
    shown = np.isfinite(pixels).all(2) & (pixels > 0).all(2) & (pixels < [640, 480]).all(2)
    camera, point = np.nonzero(shown & (shown.sum(0) > 1))
    noisy = pixels[camera, point] + rng.normal(0, 0.3, (len(camera), 2))
    wrong = rng.random(len(camera)) < 0.01
    noisy[wrong] += rng.uniform(10, 40, (int(wrong.sum()), 2))
    observations = Observations(point, camera, noisy, np.zeros(len(point), np.intp))
    return SolvedCalibration(cameras, points, observations), wrong


def guessed(truth: SolvedCalibration) -> SolvedCalibration:
    """The same with lenses of which only the focal length is known, roughly."""
    cameras = {}
    for name, filmed in truth.cameras.items():
        K = torch.tensor([[605.0, 0, 320], [0, 605.0, 240], [0, 0, 1]], dtype=torch.float64)
        cameras[name] = LensCamera(replace(filmed.camera, K=K), RadialTangential(k1=0.05))
    return replace(truth, cameras=cameras)


def test_lenses_of_phones_are_found_from_focal_lengths() -> None:
    truth, wrong = rig()
    found = adjust_together(guessed(truth), lens=range(CAMERAS), free=FREE, pixels=2.0)
    errors = calibration_errors(found.cameras, truth.cameras).values()
    assert np.median([abs(error.focal_percent) for error in errors]) < 0.4
    assert np.median([error.lens_pixels for error in errors]) < 1.0
    lost = len(wrong) - len(found.observations)
    assert wrong.sum() <= lost < 1.5 * wrong.sum()


def test_shared_lenses_stay_so() -> None:
    truth, _ = rig()
    lens = [0, *[1] * (CAMERAS - 1)]
    found = adjust_together(guessed(truth), lens=lens, free=FREE, pixels=20.0)
    first = found.cameras["cam1"]
    assert all(found.cameras[f"cam{number}"].lens == first.lens for number in range(1, CAMERAS))


def test_points_without_rays_apart_are_left_out() -> None:
    truth, _ = rig()
    far = truth.points.copy()
    far[0] = [0, 0, 1e4]
    seen = replace(truth.observations)
    pixels = seen.pixels.copy()
    for index, filmed in enumerate(truth.cameras.values()):
        own = (seen.camera == index) & (seen.point == 0)
        pixels[own] = filmed.pixels(far[:1])
    kept = cleaned(replace(truth, points=far, observations=replace(seen, pixels=pixels)), pixels=50.0)
    assert len(kept.points) == POINTS - 1 - int((np.bincount(seen.point, minlength=POINTS) == 0).sum())
