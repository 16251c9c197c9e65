# SPDX-License-Identifier: Apache-2.0
"""Textured planes as cameras with lenses film them: exact pictures at the price of a lookup."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from rigs import look_at
from structgstream.cameras import Camera
from structgstream.data.lenses import Lens, LensCamera, Pinhole

Floats = NDArray[np.float64]


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
        pixels = np.stack(np.meshgrid(across, down), -1)
        flat = filmed.to_normalized(pixels.reshape(-1, 2)).reshape(pixels.shape)
        self._rays = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], -1) @ camera.viewmat[:3, :3].numpy()
        self._eye = camera.center.numpy()

    def picture(self, planes: Sequence[Plane], *, noise: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
        """What the camera sees, ``[H, W, 3]``; the nearest plane wins, nothing is mid-grey."""
        nearest = np.full(self._rays.shape[:2], np.inf)
        picture = np.full((*nearest.shape, 3), 127, np.float32)
        for plane in planes:
            depth, seen = self._seen(plane)
            closer = (depth > 0) & (depth < nearest) & np.isfinite(seen).all(-1)
            nearest[closer], picture[closer] = depth[closer], seen[closer]
        camera = self.filmed.camera
        reduced = picture.reshape(camera.height, self._samples, camera.width, self._samples, 3).mean((1, 3))
        reduced += noise * np.random.default_rng(seed).normal(size=reduced.shape)
        return reduced.round().clip(0, 255).astype(np.uint8)

    def _seen(self, plane: Plane) -> tuple[Floats, NDArray[np.float32]]:
        """Distance along each ray and the colour there; NaN beside the plane."""
        inverse = np.linalg.inv(plane.pose)
        eye = inverse[:3, :3] @ self._eye + inverse[:3, 3]
        rays = self._rays @ inverse[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -eye[2] / rays[..., 2]
            places = (eye[:2] + rays[..., :2] * depth[..., None]) / plane.size
        inside = ((places > 0) & (places < 1)).all(-1)
        height, width = plane.texture.shape[:2]
        maps = (np.where(inside[..., None], places, -1) * (width, height) - 0.5).astype(np.float32)
        texture = plane.texture if plane.texture.ndim == 3 else np.repeat(plane.texture[..., None], 3, -1)
        seen = cv2.remap(
            texture.astype(np.float32), maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        seen[~inside] = np.nan
        return depth, np.asarray(seen, np.float32)


def ring(
    count: int,
    *,
    radius: float,
    arc_degrees: float,
    height: float = 0.0,
    size: tuple[int, int] = (480, 360),
    focal: float = 420.0,
    lens: Lens | None = None,
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> dict[str, LensCamera]:
    """Cameras on an arc around the origin that look at ``target``; world y points down."""
    found = {}
    for index in range(count):
        angle = np.radians(arc_degrees) * (index / max(count - 1, 1) - 0.5)
        eye = torch.tensor(
            [radius * np.sin(angle), height + 0.1 * radius * (-1) ** index, -radius * np.cos(angle)],
            dtype=torch.float64,
        )
        K = torch.tensor([[focal, 0, size[0] / 2 + 3], [0, focal, size[1] / 2 - 2], [0, 0, 1]], dtype=torch.float64)
        viewmat = look_at(eye, torch.tensor(target, dtype=torch.float64))
        found[f"cam{index:02d}"] = LensCamera(Camera(viewmat, K, *size), lens or Pinhole())
    return found


def board_texture(board: object, *, pixels_a_square: int = 60) -> NDArray[np.uint8]:
    """The board of :class:`structgstream.preparation.calibration.board.Board` as a picture without margin."""
    from structgstream.preparation.calibration.board import Board

    assert isinstance(board, Board)
    size = board.columns * pixels_a_square, board.rows * pixels_a_square
    return np.asarray(board.opencv_board().generateImage(size, marginSize=0), np.uint8)
