# SPDX-License-Identifier: Apache-2.0
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.errors import CaptureError
from structgstream.preparation.tone import LEAST_SAMPLES, ColorSamples, ToneEstimate, estimate_tones, sample_colors

NAMES = tuple(f"cam{number}" for number in range(8))


@dataclass(frozen=True)
class Camera:
    """How a made camera renders light: a gamma for each channel, then contrast."""

    exponents: Floats
    contrast: float

    def __call__(self, light: Floats) -> Floats:
        rendered = light.clip(0, 1) ** self.exponents
        return rendered - self.contrast * np.sin(2 * np.pi * rendered) / (2 * np.pi)


def made_cameras(seed: int = 0) -> list[Camera]:
    g = np.random.default_rng(seed)
    return [Camera(np.exp(g.uniform(-0.25, 0.25) + g.uniform(-0.04, 0.04, 3)), g.uniform(-0.2, 0.2)) for _ in NAMES]


def samples_of(cameras: Sequence[Camera], *, points: int = 1200, seed: int = 1, noise: float = 0.01) -> ColorSamples:
    """Points that two to five cameras see; every tenth observation is a highlight."""
    g = np.random.default_rng(seed)
    point, camera, colors = [], [], []
    for number in range(points):
        light = g.uniform(0.02, 0.98, 3)
        for own in g.choice(len(cameras), g.integers(2, 6), replace=False):
            shine = g.uniform(0, 0.4) if g.random() < 0.1 else 0.0
            point.append(number)
            camera.append(own)
            colors.append(np.round(cameras[own](light + shine + g.normal(0, noise, 3)) * 255) / 255)
    found = np.array(colors)
    return ColorSamples(np.array(point), np.array(camera), found, (found > 0.012) & (found < 0.988))


def disagreement(cameras: Sequence[Camera], estimate: ToneEstimate | None, names: Sequence[str] = NAMES) -> float:
    """Standard deviation over cameras of the colours that one light gets, of 255."""
    light = np.linspace(0.05, 0.95, 40)[:, None] * np.ones(3)
    shown = [
        camera(light) if estimate is None else estimate.curves[name](camera(light))
        for name, camera in zip(NAMES, cameras, strict=True)
        if name in names
    ]
    return float(np.std(shown, axis=0).mean() * 255)


def test_cameras_of_other_gamma_and_contrast_agree_afterwards() -> None:
    cameras = made_cameras()
    estimate = estimate_tones(samples_of(cameras), cameras=NAMES)
    assert disagreement(cameras, None) > 8
    assert disagreement(cameras, estimate) < 0.8
    assert set(estimate.curves) == set(estimate.errors_of) == set(NAMES)
    errors = estimate.errors
    assert errors.with_curves < 0.9 * errors.with_gains < 0.9 * errors.as_filmed


def test_the_mean_curve_is_the_identity() -> None:
    estimate = estimate_tones(samples_of(made_cameras()), cameras=NAMES)
    colors = np.linspace(0, 1, 60).reshape(20, 3)
    np.testing.assert_allclose(np.mean([curve(colors) for curve in estimate.curves.values()], 0), colors, atol=2e-3)


def test_cameras_that_agree_are_left_alone() -> None:
    same = [Camera(np.ones(3), 0.0)] * len(NAMES)
    estimate = estimate_tones(samples_of(same), cameras=NAMES)
    levels = np.linspace(0.06, 0.94, 60).reshape(20, 3)
    for curve in estimate.curves.values():
        np.testing.assert_allclose(curve(levels), levels, atol=1.5 / 255)


def test_exposure_alone_is_a_gain() -> None:
    gains = np.linspace(0.8, 1.2, len(NAMES))

    class Exposed(Camera):
        def __call__(self, light: Floats) -> Floats:
            return 0.7 * self.contrast * light

    cameras = [Exposed(np.ones(3), gain) for gain in gains]
    errors = estimate_tones(samples_of(cameras), cameras=NAMES).errors
    assert errors.with_gains < 0.6 * errors.as_filmed
    assert errors.with_curves == pytest.approx(errors.with_gains, rel=0.12)


def test_held_out_cameras_follow_and_do_not_lead() -> None:
    cameras = made_cameras()
    samples = samples_of(cameras)
    estimate = estimate_tones(samples, cameras=NAMES, held_out=("cam3",))
    assert disagreement(cameras, estimate) < 0.8
    painted = samples.colors.copy()
    painted[samples.camera == 3] = painted[samples.camera == 3] ** 2
    other = estimate_tones(replace(samples, colors=painted), cameras=NAMES, held_out=("cam3",))
    assert other.curves["cam3"] != estimate.curves["cam3"]
    assert all(other.curves[name] == estimate.curves[name] for name in NAMES if name != "cam3")


def test_a_camera_that_sees_too_little_gets_no_curve() -> None:
    samples = samples_of(made_cameras())
    rare = (samples.camera == 5) & (np.arange(len(samples.point)) % 20 > 0)
    estimate = estimate_tones(ColorSamples(*(values[~rare] for values in vars(samples).values())), cameras=NAMES)
    assert set(estimate.curves) == set(NAMES) - {"cam5"}


def test_cameras_without_common_points_are_told() -> None:
    alone = ColorSamples(np.arange(500), np.arange(500) % 8, np.full((500, 3), 0.5), np.ones((500, 3), bool))
    with pytest.raises(CaptureError, match=rf"need {LEAST_SAMPLES} points.*cam0 has 0.*without tone curves"):
        estimate_tones(alone, cameras=NAMES)


def test_one_seed_gives_one_answer() -> None:
    samples = samples_of(made_cameras())
    assert estimate_tones(samples, cameras=NAMES, seed=4) == estimate_tones(samples, cameras=NAMES, seed=4)


@dataclass(frozen=True)
class MadeTracks:
    point: NDArray[np.int64]
    camera: NDArray[np.int64]
    pixels: Floats
    instant: NDArray[np.int64]


def test_colours_are_taken_around_pixels_and_clipped_ones_are_marked() -> None:
    picture = np.zeros((300, 400, 3), np.uint8)
    picture[:150, :200], picture[150:, :200] = (60, 120, 180), (60, 120, 255)
    picture[:150, 200:], picture[150:, 200:] = (0, 120, 180), (90, 90, 90)
    later = np.full((300, 400, 3), 33, np.uint8)
    pixels = np.array([[50.5, 50.5], [50.5, 250.5], [250.5, 50.5], [250.5, 250.5], [50.5, 50.5], [1.0, 50.0]])
    tracks = MadeTracks(np.arange(6), np.array([1, 1, 1, 1, 1, 1]), pixels, np.array([0, 0, 0, 0, 1, 0]))
    samples = sample_colors({"b": [picture, later]}, tracks, cameras=("a", "b"))
    expected = [(60, 120, 180), (60, 120, 255), (0, 120, 180), (90, 90, 90), (33, 33, 33)]
    np.testing.assert_allclose(samples.colors[:5] * 255, expected, atol=1e-3)
    assert samples.usable.tolist() == [
        [True, True, True],
        [True, True, False],
        [False, True, True],
        [True, True, True],
        [True, True, True],
        [False, False, False],
    ]
