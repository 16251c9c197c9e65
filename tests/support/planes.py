# SPDX-License-Identifier: Apache-2.0
"""A room of textured planes whose depth is known everywhere, seen by cameras of different exposure."""

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.matching import back_project, project
from structgstream.frames import MultiViewFrame
from tests.support.rigs import look_at

WIDTH, HEIGHT = 160, 120
# y points down: a back wall, a floor, and a board that stands in front of the wall.
WALL_Z, FLOOR_Y, BOARD_Z = 1.5, 0.7, 0.4
BOARD = (-0.5, 0.3, -0.4, 0.4)
EXPOSURES = (1.0, 0.75, 1.1, 0.9, 0.8, 1.05)


def room_rig(cameras: int = 6) -> CameraRig:
    """Cameras on an arc above the floor, 2.5 from the board; the last one is held out."""
    angles = np.linspace(-0.4, 0.4, cameras)
    K = torch.tensor([[150.0, 0.0, WIDTH / 2], [0.0, 150.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    rig = {}
    for index, angle in enumerate(angles):
        eye = torch.tensor(
            [2.5 * np.sin(angle), -0.5 + 0.15 * (-1) ** index, BOARD_Z - 2.5 * np.cos(angle)], dtype=torch.float64
        )
        target = torch.tensor([0.0, 0.1, BOARD_Z], dtype=torch.float64)
        rig[f"cam{index:02d}"] = Camera(look_at(eye, target), K, WIDTH, HEIGHT)
    return CameraRig(rig, frozenset({f"cam{cameras - 1:02d}"}))


def room_depth(camera: Camera) -> NDArray[np.float64]:
    """Depth ``[H, W]`` along z of the nearest plane."""
    return _hit(camera)[0]


def room_frame(rig: CameraRig, *, textured: bool = True) -> MultiViewFrame:
    images = {}
    for index, name in enumerate(rig):
        grey = _texture(*_hit(rig[name])[1:]) if textured else np.full((HEIGHT, WIDTH, 3), 0.5)
        exposed = 255 * np.clip(grey * EXPOSURES[index % len(EXPOSURES)], 0, 1)
        images[name] = exposed.round().astype(np.uint8)
    return MultiViewFrame(0, 0.0, images)


def distance_to_surface(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance ``[P]`` of points ``[P, 3]`` to the nearest of the three planes."""
    left, right, top, bottom = BOARD
    dx = np.maximum(0, np.maximum(left - points[:, 0], points[:, 0] - right))
    dy = np.maximum(0, np.maximum(top - points[:, 1], points[:, 1] - bottom))
    board = np.sqrt(dx**2 + dy**2 + (points[:, 2] - BOARD_Z) ** 2)
    return np.minimum(np.minimum(np.abs(points[:, 2] - WALL_Z), np.abs(points[:, 1] - FLOOR_Y)), board)


def _hit(camera: Camera) -> tuple[NDArray[np.float64], ...]:
    """Depth, texture coordinates and number of the plane ``[H, W]`` that each pixel sees."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([column.ravel(), row.ravel()], 1).astype(np.float64)
    eye = camera.center.numpy()
    direction = back_project(camera, pixels, np.ones(len(pixels))) - eye
    with np.errstate(divide="ignore"):
        depths = [(limit - eye[axis]) / direction[:, axis] for axis, limit in ((2, WALL_Z), (1, FLOOR_Y), (2, BOARD_Z))]
    board = eye + direction * depths[2][:, None]
    left, right, top, bottom = BOARD
    on_board = (board[:, 0] > left) & (board[:, 0] < right) & (board[:, 1] > top) & (board[:, 1] < bottom)
    depths[2][~on_board] = np.inf
    stacked = np.stack([np.where(depth > 0, depth, np.inf) for depth in depths])
    which, depth = stacked.argmin(0), stacked.min(0)
    point = eye + direction * depth[:, None]
    u, v = point[:, 0], np.where(which == 1, point[:, 2], point[:, 1])
    assert np.allclose(project(camera, point)[0], pixels)
    return tuple(values.reshape(HEIGHT, WIDTH) for values in (depth, u, v, which))


def _texture(u: NDArray[np.float64], v: NDArray[np.float64], which: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth noise of three octaves, another one on each plane, ``[H, W, 3]`` in [0, 1]."""
    total = np.zeros((*u.shape, 3))
    for plane in range(3):
        rng = np.random.default_rng((0, plane))
        value = np.zeros((*u.shape, 3))
        for cell, weight in ((0.3, 0.3), (0.12, 0.4), (0.06, 0.3)):
            lattice = rng.random((64, 64, 3))
            x, y = u / cell, v / cell
            x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
            fx, fy = (x - x0)[..., None], (y - y0)[..., None]
            top = lattice[y0 % 64, x0 % 64] * (1 - fx) + lattice[y0 % 64, (x0 + 1) % 64] * fx
            bottom = lattice[(y0 + 1) % 64, x0 % 64] * (1 - fx) + lattice[(y0 + 1) % 64, (x0 + 1) % 64] * fx
            value += weight * (top * (1 - fy) + bottom * fy)
        total[which == plane] = value[which == plane]
    return total * 0.9
