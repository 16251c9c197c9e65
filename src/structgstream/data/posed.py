# SPDX-License-Identifier: Apache-2.0
"""The common result of reading calibration files: lens, intrinsics and pose by camera name."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from structgstream.data.lenses import Lens, Pinhole
from structgstream.data.text_files import Unreadable, number


@dataclass(frozen=True)
class PosedCamera:
    """One camera of a calibration, or one picture that a camera took.

    Args:
        name: the camera's, or a path of which its name is a part (``cam00/000017.png``).
        viewmat: ``[4, 4]`` float64, world to camera, OpenCV axes.
        K: ``[3, 3]`` float64, pixels, the top-left pixel's centre at (0.5, 0.5).
        size: width and height, pixels, that ``K`` is for; None where the file does not say: that of the pictures.
        lens: its distortion.
    """

    name: str
    viewmat: NDArray[np.float64]
    K: NDArray[np.float64]
    size: tuple[int, int] | None
    lens: Lens = field(default_factory=Pinhole)

    @property
    def center(self) -> NDArray[np.float64]:
        """Position in the world, ``[3]``."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass(frozen=True)
class Calibration:
    """Cameras of one capture.

    Args:
        where: the file or folder that they come from, for messages.
        cameras: as :class:`PosedCamera`; several of one camera must agree.
        points: ``[P, 3]`` points of the scene, or None.
        held_out: names of cameras that are kept from training as published.
        unposed: names of cameras that it has no pose of.
        turned_by_exif: whether it is for pictures turned as their EXIF orientation says, as OpenCV reads them; None
            where that depends on how it was made.
    """

    where: Path
    cameras: tuple[PosedCamera, ...]
    points: NDArray[np.float64] | None = None
    held_out: Sequence[str] = ()
    unposed: Sequence[str] = ()
    turned_by_exif: bool | None = None


def rigid(rotation: ArrayLike, translation: ArrayLike) -> NDArray[np.float64]:
    """The matrix ``[4, 4]`` of a rotation ``[3, 3]``, or a vector ``[3]`` in radians, and a translation ``[3]``.

    Raises:
        Unreadable: other shapes.
    """
    turned, moved = np.array(rotation, dtype=np.float64), np.array(translation, dtype=np.float64).reshape(-1)
    if turned.size == 3:
        turned = rotation_matrix(turned.reshape(3))
    elif turned.shape == (9,):
        turned = turned.reshape(3, 3)
    if turned.shape != (3, 3) or moved.shape != (3,):
        raise Unreadable(f"a rotation of shape {turned.shape} and a translation of shape {moved.shape}")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turned, moved
    return matrix


def rotation_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rodrigues' formula: ``[3, 3]`` of an axis times an angle in radians, ``[3]``."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def intrinsics(fx: Any, fy: Any, cx: Any, cy: Any) -> NDArray[np.float64]:
    """The matrix ``[3, 3]`` of focal lengths and principal point, pixels.

    Raises:
        Unreadable: one is no finite number.
    """
    fx, fy, cx, cy = map(number, (fx, fy, cx, cy))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)
