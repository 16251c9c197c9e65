# SPDX-License-Identifier: Apache-2.0
"""Pinhole cameras, camera rigs, and the similarity transform from a capture's units to those of a scene.

OpenCV axes (x right, y down, z forward), ``viewmat`` maps world to camera, ``K`` is in pixels with the centre of the
top-left pixel at (0.5, 0.5). See ``docs/conventions.md``. Learning rates and voxel sizes are defined for scenes of one
size (paper, section Implementations), so training runs in normalised units. The stream header stores the transform.
"""

import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from structgstream.errors import CalibrationError


class Viewport(NamedTuple):
    """A camera in the form that kernels take, with the dtype and device of the drawn tensors."""

    viewmat: Tensor  # [4, 4] world to camera
    K: Tensor  # [3, 3] pixels
    center: Tensor  # [3] position of the camera
    width: int  # pixels
    height: int  # pixels
    near: float  # distance of the near plane along z


REFERENCE_PIXELS = 640
"""Longer side, in pixels, of the largest pictures for which lengths in pixels were chosen (320 x 240 to 640 x 360).
Lengths are scaled for larger pictures, in which the same content covers more pixels (:func:`enlargement`)."""


def enlargement(width: float, height: float) -> float:
    """Side of a pixel of the reference size, in pixels of a picture of ``width`` x ``height``; at least 1.

    Lengths in pixels of a configuration are multiplied by it, areas in pixels by its square. They are not scaled for
    pictures below the reference size (lab/notes/scaling.md).
    """
    return max(1.0, max(width, height) / REFERENCE_PIXELS)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Args:
        viewmat: ``[4, 4]`` float64, world to camera.
        K: ``[3, 3]`` float64, pixels.
        width: image width, pixels.
        height: image height, pixels.
        near: distance of the near plane along z, in the units of ``viewmat``.

    Raises:
        CalibrationError: a value is not finite, the view matrix is not rigid, or a focal length or size is not
            positive.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    near: float = 0.01
    _viewports: dict[tuple[torch.dtype, torch.device], Viewport] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _resized: "dict[tuple[int, int], Camera]" = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "viewmat", torch.as_tensor(self.viewmat, dtype=torch.float64).cpu())
        object.__setattr__(self, "K", torch.as_tensor(self.K, dtype=torch.float64).cpu())
        if self.viewmat.shape != (4, 4) or self.K.shape != (3, 3):
            raise CalibrationError(
                f"A camera needs a 4x4 view matrix and 3x3 intrinsics, "
                f"got {tuple(self.viewmat.shape)} and {tuple(self.K.shape)}."
            )
        if not (torch.isfinite(self.viewmat).all() and torch.isfinite(self.K).all()):
            raise CalibrationError("The calibration has a number that is not finite (NaN or infinity).")
        rotation = self.viewmat[:3, :3]
        if (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max() > 1e-3 or rotation.det() < 0:
            raise CalibrationError(
                "The rotation of the view matrix is not orthonormal with determinant +1; expected a rigid "
                "world-to-camera matrix (OpenCV axes) without scale or mirror."
            )
        try:
            object.__setattr__(self, "width", operator.index(self.width))
            object.__setattr__(self, "height", operator.index(self.height))
        except TypeError:
            raise CalibrationError(f"A picture has whole pixels, got {self.width!r}x{self.height!r}.") from None
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0 or self.width <= 0 or self.height <= 0:
            raise CalibrationError(
                f"Focal lengths and image size must be positive, got fx={self.K[0, 0]:g}, fy={self.K[1, 1]:g}, "
                f"{self.width}x{self.height}."
            )

    @property
    def center(self) -> Tensor:
        """Position of the camera in the world, ``[3]`` float64."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def viewport(self, like: Tensor) -> Viewport:
        """The camera with the dtype and device of ``like``; cached, because a copy to a GPU blocks the host."""
        key = (like.dtype, like.device)
        if key not in self._viewports:
            self._viewports[key] = Viewport(
                self.viewmat.to(like), self.K.to(like), self.center.to(like), self.width, self.height, self.near
            )
        return self._viewports[key]

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera with its picture resampled to ``width x height`` pixels; cached, as :meth:`viewport` is.

        The intrinsics scale with the picture; pixel centres at +0.5 need no half-pixel shift.
        """
        if (width, height) not in self._resized:
            factors = torch.tensor([[width / self.width], [height / self.height], [1.0]], dtype=torch.float64)
            self._resized[width, height] = replace(self, K=self.K * factors, width=width, height=height)
        return self._resized[width, height]

    def scaled(self, scale: float) -> "Camera":
        """:meth:`resized` to ``scale`` times the size, rounded to whole pixels, at least one."""
        return self.resized(max(1, round(self.width * scale)), max(1, round(self.height * scale)))


@dataclass(frozen=True)
class CameraRig:
    """Named cameras, constant during a stream, and the names of those that are held out from training.

    Everything that is stored per camera follows the order of ``cameras``.
    """

    cameras: Mapping[str, Camera]
    held_out: frozenset[str] = field(default_factory=frozenset)

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Mapping) or not all(isinstance(name, str) for name in self.cameras):
            raise CalibrationError("A rig has cameras by name, as {'cam00': Camera(...), ...}.")
        if isinstance(self.held_out, str):
            raise CalibrationError(f"held_out takes names of cameras, as ({self.held_out!r},); got {self.held_out!r}.")
        object.__setattr__(self, "held_out", frozenset(self.held_out))
        unknown = sorted(self.held_out - set(self.cameras))
        if unknown:
            raise CalibrationError(
                f"Held-out cameras {unknown} are not in the rig; it has {', '.join(sorted(self.cameras))}."
            )
        if len(self.training) < 2:
            raise CalibrationError(
                f"A reconstruction needs at least two training cameras, got {len(self.training)} "
                f"({len(self.cameras)} in the capture, {len(self.held_out)} held out)."
            )

    def __getitem__(self, name: str) -> Camera:
        return self.cameras[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def training(self) -> tuple[str, ...]:
        """Names of the cameras used for training, in rig order."""
        return tuple(name for name in self.cameras if name not in self.held_out)

    @property
    def testing(self) -> tuple[str, ...]:
        """Names of the held-out cameras, in rig order."""
        return tuple(name for name in self.cameras if name in self.held_out)

    @property
    def centers(self) -> Tensor:
        """Camera positions, ``[V, 3]`` float64, in rig order."""
        return torch.stack([camera.center for camera in self.cameras.values()])

    def plain(self) -> dict[str, dict[str, Any]]:
        """Each camera as plain JSON values, by name."""
        return {
            name: {
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "viewmat": camera.viewmat.tolist(),
                "near": camera.near,
                "held_out": name in self.held_out,
            }
            for name, camera in self.cameras.items()
        }

    def with_held_out(self, names: frozenset[str]) -> "CameraRig":
        """The same cameras with another held-out set."""
        return replace(self, held_out=names)

    def mapped(self, cameras: Mapping[str, Camera]) -> "CameraRig":
        """The same names and held-out set with other cameras (for example resized)."""
        return replace(self, cameras=dict(cameras))


@dataclass(frozen=True)
class Similarity:
    """``normalised = (world - center) * scale``, without rotation."""

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def points(self, points: Tensor) -> Tensor:
        """World points ``[..., 3]`` to normalised ones."""
        return (points - torch.tensor(self.center, dtype=points.dtype)) * self.scale

    def inverse_points(self, points: Tensor) -> Tensor:
        """Normalised points ``[..., 3]`` back to the capture's own units."""
        return points / self.scale + torch.tensor(self.center, dtype=points.dtype)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the capture in normalised units; it shows the same picture."""
        viewmat = camera.viewmat.clone()
        center = torch.tensor(self.center, dtype=torch.float64)
        viewmat[:3, 3] = (camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3]) * self.scale
        return replace(camera, viewmat=viewmat, near=camera.near * self.scale)

    def rig(self, rig: CameraRig) -> CameraRig:
        """Every camera of ``rig`` through :meth:`camera`."""
        return rig.mapped({name: self.camera(rig[name]) for name in rig})


MAX_SKEW_PIXELS = 0.5
ONE_PLACE = 1e-12
"""Cameras are at one place if they are nearer to each other than this share of their distance to the origin, which
rounding errors alone can cause."""


def skew_pixels(camera: Camera) -> float:
    """How far the skew of the intrinsics, which is not drawn, moves the upper and lower border of the picture."""
    return float(camera.K[0, 1].abs() / camera.K[1, 1]) * camera.height / 2


def check_matrices(camera: Camera) -> None:
    """Check that the view matrix is one of a rigid motion, not a transposed one, and the intrinsics are of a pinhole.

    Raises:
        CalibrationError: they are not, or the near plane is not positive.
    """
    rows = {"view matrix": (camera.viewmat[3], [0.0, 0.0, 0.0, 1.0]), "K": (camera.K[2], [0.0, 0.0, 1.0])}
    for name, (row, expected) in rows.items():
        if not torch.allclose(row, torch.tensor(expected, dtype=row.dtype), rtol=0, atol=1e-6):
            raise CalibrationError(
                f"The last row of the {name} is {row.tolist()}; expected {expected}. Matrices are given row by row: "
                "transpose it if it is column by column."
            )
    if not 0 < camera.near < math.inf:
        raise CalibrationError(f"The near plane must be positive, got {camera.near:g}.")


def check_places(cameras: Sequence[Camera]) -> None:
    """Check that not all cameras stand at one place. Raises CalibrationError if they do."""
    centers = torch.stack([camera.center for camera in cameras])
    if len(cameras) > 1 and (centers - centers[0]).norm(dim=1).max() <= ONE_PLACE * centers.norm(dim=1).max():
        raise CalibrationError(
            f"All {len(cameras)} cameras stand at one place, so nothing has a depth; look whether the translations of "
            "their poses are missing."
        )


def check_rig(rig: CameraRig) -> None:
    """Check that the cameras can be drawn as they are calibrated, and see depth.

    Raises:
        CalibrationError: a matrix is of another form (:func:`check_matrices`), pixels are not rectangular, or the
            training cameras stand at one place.
    """
    check_places([rig[name] for name in rig.training])
    for name in rig:
        try:
            check_matrices(rig[name])
        except CalibrationError as error:
            raise CalibrationError(f"Camera {name!r}: {error}") from None
        if skew_pixels(rig[name]) > MAX_SKEW_PIXELS or rig[name].K[1, 0] != 0:
            raise CalibrationError(
                f"Camera {name!r} has a K whose first two rows are {rig[name].K[:2].tolist()}; expected [fx, 0, cx] "
                "and [0, fy, cy]: calibrate without skew, or undistort the pictures."
            )


NEAR_IN_RIG_RADII = 0.12
"""Default distance of the near plane, in rig radii. In a dome each camera stands in the wall that the others see, and
what is close to a camera must not be drawn."""


def rig_radius(rig: CameraRig) -> float:
    """Largest distance of a training camera to the mean training-camera position, in the capture's units."""
    centers = torch.stack([rig[name].center for name in rig.training])
    return float((centers - centers.mean(0)).norm(dim=1).max())


def normalizing_similarity(rig: CameraRig, *, radius: float) -> Similarity:
    """The similarity that moves the training cameras' mean to the origin and makes the rig's radius ``radius``."""
    centers = torch.stack([rig[name].center for name in rig.training])
    center = centers.mean(0)
    return Similarity(center=(float(center[0]), float(center[1]), float(center[2])), scale=radius / rig_radius(rig))
