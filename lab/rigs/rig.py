# SPDX-License-Identifier: Apache-2.0
"""Where the cameras of the rigs stand, and the pictures that have to be path traced for them.

Nine cameras stand in front of the set table of ``lab/clip``, in two rows over 60 degrees, as people place them:
not all at one distance nor quite upright, each aimed a little beside the middle. ``cam00`` is surrounded by the
others. The lenses of most rigs are resampled from one wide, dense pinhole picture of each camera; fisheyes are traced
ray by ray.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.lenses import Fisheye, LensCamera, Pinhole
from structgstream.geometry import Floats

TARGET = (0.02, 0.12, 0.155)  # metres; the middle of the table is the origin, z points up
RADIUS_METRES = 1.5
NEAR_METRES = 0.6
DIRECTIONS = (  # azimuth and elevation in degrees; azimuth 0 looks along +y
    (0.0, 17.0),
    (-30.0, 9.0), (-11.0, 8.0), (11.0, 9.0), (30.0, 8.0),
    (-24.0, 25.0), (-8.0, 27.0), (8.0, 26.0), (24.0, 25.0),
)  # fmt: skip
NAMES = tuple(f"cam{number:02d}" for number in range(len(DIRECTIONS)))
HELD_OUT = NAMES[0]

BUMPED = "cam04"
BUMP_DEGREES, BUMP_METRES = 0.8, 0.012

STEP_SECONDS = 1 / 60
STEPS = 9  # states of the scene, 0 to 0.133 s

BASE_DEGREES, BASE_SIZE = 68.0, (880, 660)
FISHEYE_SIZE, FISHEYE_DEGREES, FISHEYE_CIRCLE_DEGREES = (880, 660), 150.0, 162.0
FISHEYE_STEPS = (0, 2, 4, 6)


def look_at(eye: Floats, target: Floats, *, roll_degrees: float = 0.0) -> torch.Tensor:
    """World-to-camera matrix ``[4, 4]``, OpenCV axes, of a camera whose picture is upright but for ``roll_degrees``."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = turned("z", roll_degrees) @ np.array([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return torch.from_numpy(viewmat)


def turned(axis: str, degrees: float) -> Floats:
    """Rotation ``[3, 3]`` about an axis of the camera."""
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    out = np.eye(3)
    out[[first, second], [first, second]] = math.cos(math.radians(degrees))
    out[first, second], out[second, first] = -math.sin(math.radians(degrees)), math.sin(math.radians(degrees))
    return out


def poses(seed: int = 14) -> dict[str, torch.Tensor]:
    """The view matrix of every camera."""
    rng = np.random.default_rng(seed)
    found = {}
    for name, (azimuth, elevation) in zip(NAMES, np.deg2rad(DIRECTIONS), strict=True):
        direction = np.array(
            [math.sin(azimuth) * math.cos(elevation), -math.cos(azimuth) * math.cos(elevation), math.sin(elevation)]
        )
        eye = np.array(TARGET) + RADIUS_METRES * rng.uniform(0.92, 1.04) * direction
        aimed = np.array(TARGET) + rng.uniform(-0.04, 0.04, 3)
        found[name] = look_at(eye, aimed, roll_degrees=rng.uniform(-2.5, 2.5))
    return found


def bumped(viewmat: torch.Tensor) -> torch.Tensor:
    """The pose of a camera after someone has knocked against it."""
    moved = np.eye(4)
    moved[:3, :3] = turned("y", BUMP_DEGREES) @ turned("x", -BUMP_DEGREES / 2)
    moved[:3, 3] = [BUMP_METRES, 0.0, -BUMP_METRES / 2]
    return torch.from_numpy(moved) @ viewmat


def base(viewmat: torch.Tensor) -> LensCamera:
    """The pinhole camera whose pictures are traced, wider and denser than those that are filmed."""
    width, height = BASE_SIZE
    focal = width / 2 / math.tan(math.radians(BASE_DEGREES) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return LensCamera(Camera(viewmat, K, width, height, near=NEAR_METRES), Pinhole())


def fisheye(viewmat: torch.Tensor, *, seed: int) -> LensCamera:
    """A fisheye lens of :data:`FISHEYE_DEGREES` across its picture; each is a little different."""
    rng = np.random.default_rng(seed)
    k1, k2 = rng.uniform(-0.024, -0.016), rng.uniform(0.0015, 0.0025)
    lens = Fisheye(k1, k2)
    width, height = FISHEYE_SIZE
    edge = math.radians(FISHEYE_DEGREES) / 2
    focal = width / 2 / (edge * (1 + k1 * edge**2 + k2 * edge**4)) * rng.uniform(0.995, 1.005)
    cx, cy = np.array([width / 2, height / 2]) + rng.uniform(-6, 6, 2)
    K = torch.tensor([[focal, 0, cx], [0, focal, cy], [0, 0, 1]], dtype=torch.float64)
    return LensCamera(Camera(viewmat, K, width, height, near=NEAR_METRES), lens)


@dataclass(frozen=True)
class Traced:
    """One camera that is path traced, and at which steps of the scene."""

    camera: LensCamera
    steps: tuple[int, ...]


def traced() -> dict[str, Traced]:
    """Everything that is path traced, by the name of its files (``base-cam00``, ``bumped-cam04``, ...)."""
    steps = tuple(range(STEPS))
    found = {f"base-{name}": Traced(base(viewmat), steps) for name, viewmat in poses().items()}
    found[f"bumped-{BUMPED}"] = Traced(base(bumped(poses()[BUMPED])), steps)
    for number, (name, viewmat) in enumerate(poses().items()):
        found[f"fisheye-{name}"] = Traced(fisheye(viewmat, seed=number), FISHEYE_STEPS)
    return found


def corner_directions(camera: LensCamera) -> NDArray[np.float32]:
    """World directions ``[H + 1, W + 1, 3]`` through the corners of pixels; zero outside of the lens's image circle."""
    across, down = np.meshgrid(np.arange(camera.camera.width + 1.0), np.arange(camera.camera.height + 1.0))
    normalised = camera.to_normalized(np.stack([across, down], -1))
    shown = np.linalg.norm(normalised, axis=-1) < math.tan(math.radians(FISHEYE_CIRCLE_DEGREES) / 2)  # NaN is not
    local = np.concatenate([normalised, np.ones_like(across)[..., None]], -1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    world = local @ camera.camera.viewmat[:3, :3].numpy()
    return np.where(shown[..., None], world, 0.0).astype(np.float32)
