# SPDX-License-Identifier: Apache-2.0
"""Textured planes as cameras with lenses film them: exact pictures at the price of a lookup."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from structgstream.cameras import Camera
from structgstream.data.calibration import rotation_matrix
from structgstream.data.lenses import Lens, LensCamera, Pinhole, RadialTangential
from structgstream.geometry import Floats
from structgstream.preparation.calibration.board import Board
from tests.support.rigs import look_at

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Plane:
    """A picture ``[h, w]`` or ``[h, w, 3]`` on a plane of the world.

    Args:
        texture: uint8.
        pose: ``[4, 4]``, plane to world; the texture's top-left corner is the origin, x goes right, y down.
        size: width and height in the world's unit.
    """

    texture: NDArray[np.uint8]
    pose: Floats
    size: tuple[float, float]


class Film:
    """A camera with a lens that films planes; the rays of its pixels are computed once."""

    def __init__(self, filmed: LensCamera, *, samples: int = 2) -> None:
        camera = filmed.camera
        self.filmed, self._samples = filmed, samples
        across, down = ((np.arange(count * samples) + 0.5) / samples for count in (camera.width, camera.height))
        flat = _normalized(filmed, across, down)
        self._rays = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], -1) @ camera.viewmat[:3, :3].numpy()
        self._eye = camera.center.numpy()

    def picture(self, planes: Sequence[Plane], *, noise: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
        """What the camera sees, ``[H, W, 3]``; the nearest plane wins, nothing is mid-grey."""
        nearest = np.full(self._rays.shape[:2], np.inf)
        picture = np.full((*nearest.shape, 3), 127, np.float32)
        for plane in planes:
            window = self._window(plane)
            depth, seen = self._seen(plane, self._rays[window])
            closer = (depth > 0) & (depth < nearest[window]) & np.isfinite(seen[..., 0])
            nearest[window][closer], picture[window][closer] = depth[closer], seen[closer]
        camera = self.filmed.camera
        reduced = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)  # means of samples
        reduced += noise * np.random.default_rng(seed).normal(size=reduced.shape)
        return reduced.round().clip(0, 255).astype(np.uint8)

    def _window(self, plane: Plane) -> tuple[slice, slice]:
        """Rows and columns of the samples that may see a plane: every eighth is looked at."""
        depth, places = self._places(plane, self._rays[::8, ::8])
        seen = np.nonzero((depth > 0) & ((places > 0) & (places < 1)).all(-1))
        rows, columns = (slice(max(8 * (at.min() - 1), 0), 8 * (at.max() + 2)) if len(at) else slice(0) for at in seen)
        return rows, columns

    def _places(self, plane: Plane, rays: Floats) -> tuple[Floats, Floats]:
        """Distance along each ray, and where it meets the plane ``[..., 2]`` in parts of its size."""
        inverse = np.linalg.inv(plane.pose)
        eye = inverse[:3, :3] @ self._eye + inverse[:3, 3]
        rays = rays @ inverse[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -eye[2] / rays[..., 2]
            return depth, (eye[:2] + rays[..., :2] * depth[..., None]) / plane.size

    def _seen(self, plane: Plane, rays: Floats) -> tuple[Floats, NDArray[np.float32]]:
        """Distance along each ray and the colour there; NaN beside the plane."""
        depth, places = self._places(plane, rays)
        x, y = places[..., 0], places[..., 1]
        inside = np.asarray((x > 0) & (x < 1) & (y > 0) & (y < 1))  # .all(-1) takes five times as long
        if not inside.any():
            return depth, np.full((*depth.shape, 3), np.nan, np.float32)
        height, width = plane.texture.shape[:2]
        maps = (np.where(inside[..., None], places, -1) * (width, height) - 0.5).astype(np.float32)
        texture = plane.texture if plane.texture.ndim == 3 else np.repeat(plane.texture[..., None], 3, -1)
        seen = cv2.remap(
            texture.astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        seen[~inside] = np.nan
        return depth, np.asarray(seen, np.float32)


def _normalized(filmed: LensCamera, across: Floats, down: Floats) -> Floats:
    """Undistorted coordinates ``[h, w, 2]`` of a grid of pixels: a spline through every eighth, within 1e-6."""
    columns, rows = (np.linspace(axis[0], axis[-1], len(axis) // 8) for axis in (across, down))
    grid = np.stack(np.meshgrid(columns, rows), -1)
    coarse = filmed.to_normalized(grid.reshape(-1, 2)).reshape(grid.shape)
    return np.stack([RectBivariateSpline(rows, columns, coarse[..., i])(down, across) for i in (0, 1)], -1)


def ring(
    count: int,
    *,
    radius: float,
    arc_degrees: float,
    size: tuple[int, int] = (480, 360),
    focal: float = 420.0,
    lens: Lens | None = None,
) -> dict[str, LensCamera]:
    """Cameras on an arc around the origin that look at it; world y points down."""
    found = {}
    for index in range(count):
        angle = np.radians(arc_degrees) * (index / max(count - 1, 1) - 0.5)
        eye = torch.tensor(
            [radius * np.sin(angle), 0.1 * radius * (-1) ** index, -radius * np.cos(angle)], dtype=torch.float64
        )
        K = torch.tensor([[focal, 0, size[0] / 2 + 3], [0, focal, size[1] / 2 - 2], [0, 0, 1]], dtype=torch.float64)
        viewmat = look_at(eye, torch.zeros_like(eye))
        found[f"cam{index:02d}"] = LensCamera(Camera(viewmat, K, *size), lens or Pinhole())
    return found


@cache
def filmed_room() -> tuple[dict[str, LensCamera], dict[str, list[Picture]]]:
    """Five cameras with mild lenses around a room, and a picture of each."""
    lens = RadialTangential(k1=-0.12, k2=0.02)
    rig = ring(5, radius=2.6, arc_degrees=60, focal=290, lens=lens, size=(320, 240))
    for camera in rig.values():
        camera.camera.K[0, 2], camera.camera.K[1, 2] = 160, 120
    return rig, {
        name: [Film(one).picture(room(), noise=1, seed=index)] for index, (name, one) in enumerate(rig.items())
    }


def board_plane(board: Board, pose: Floats, *, pixels_a_square: int = 40) -> Plane:
    """``board`` with a white margin of half a square; ``pose [4, 4]`` is that of the board's top-left corner."""
    margin = pixels_a_square // 2
    size = (board.columns + 1) * pixels_a_square, (board.rows + 1) * pixels_a_square
    texture = board.opencv_board().generateImage(size, marginSize=margin)
    moved = pose.copy()
    moved[:3, 3] -= pose[:3, :2].sum(1) * board.square_metres / 2
    width, height = (side + board.square_metres for side in board.size_metres)
    return Plane(np.asarray(texture, np.uint8), moved, (width, height))


def noise_texture(seed: int, *, size: int = 768) -> NDArray[np.uint8]:
    """Blobs of many sizes in colour, ``[size, size, 3]``."""
    generator = np.random.default_rng(seed)
    total = np.zeros((size, size, 3), np.float32)
    for cells in (12, 24, 48, 96, 160):
        coarse = generator.normal(size=(cells, cells, 3)).astype(np.float32)
        total += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    total -= total.min()
    return np.asarray(255 * total / total.max(), np.uint8)


@cache
def room(seed: int = 0) -> tuple[Plane, ...]:
    """A floor, a back wall and standing boards around the origin, each with a texture of its own; y points down."""
    sheets = [
        ((-2.0, 0.8, -2.0), (90.0, 0.0), (4.0, 4.0)),  # floor
        ((-2.2, -1.6, 1.8), (0.0, 0.0), (4.4, 2.4)),  # back wall
        ((-1.0, -0.6, 0.5), (0.0, 25.0), (0.9, 1.3)),
        ((0.2, -0.5, 0.2), (0.0, -30.0), (0.9, 1.2)),
        ((-0.4, 0.0, -0.5), (0.0, 5.0), (0.8, 0.7)),
    ]
    planes = []
    for index, (corner, (pitch, yaw), size) in enumerate(sheets):
        pose = np.eye(4)
        pose[:3, :3] = turned(yaw, axis=1) @ turned(pitch, axis=0)
        pose[:3, 3] = corner
        planes.append(Plane(noise_texture(100 * seed + index), pose, size))
    return tuple(planes)


def turned(degrees: float, *, axis: int) -> Floats:
    """The rotation ``[3, 3]`` about a coordinate axis."""
    return rotation_matrix(np.radians(degrees) * np.eye(3)[axis])
