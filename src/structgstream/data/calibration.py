# SPDX-License-Identifier: Apache-2.0
"""Calibrated cameras: what calibration files contain (:class:`Calibration`), the formats of such files
(:class:`CalibrationFormat`), rigs made of them, and the similarity transform between two estimates of one rig.

Errors name the camera and the file.
"""

import logging
import operator
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import from_numpy

from structgstream.cameras import NEAR_IN_RIG_RADII, Camera, CameraRig, check_matrices, check_places, rig_radius
from structgstream.data.lenses import Lens, LensCamera, Pinhole
from structgstream.data.text_files import BROKEN, Unreadable, number, readable, reason
from structgstream.errors import CalibrationError, CaptureError
from structgstream.geometry import Floats, cross_matrices

Entry = TypeVar("Entry")
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PosedCamera:
    """One camera of a calibration, or one picture that a camera took."""

    name: str  # the camera's, or a path of which its name is a part (``cam00/000017.png``)
    viewmat: NDArray[np.float64]  # ``[4, 4]`` float64, world to camera, OpenCV axes
    K: NDArray[np.float64]  # ``[3, 3]`` float64, pixels, the top-left pixel's centre at (0.5, 0.5)
    size: tuple[int, int] | None
    """Width and height, pixels, that ``K`` is for; None if the file does not state it: that of the pictures."""
    lens: Lens = field(default_factory=Pinhole)  # its distortion

    @property
    def center(self) -> NDArray[np.float64]:
        """Position in the world, ``[3]``."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass(frozen=True)
class Calibration:
    """Cameras of one capture."""

    where: Path  # the file or folder that they come from, for messages
    cameras: tuple[PosedCamera, ...]  # as :class:`PosedCamera`; several of one camera must agree
    points: NDArray[np.float64] | None = None  # ``[P, 3]`` points of the scene, or None
    held_out: Sequence[str] = ()  # names of cameras that are held out in published results
    unposed: Sequence[str] = ()  # names of cameras without a pose
    turned_by_exif: bool | None = None
    """Whether it is for pictures turned by their EXIF orientation, as OpenCV reads them; None where that depends on how
    it was made."""


FULL_TURN = 2 * np.pi + 1e-6  # radians; optimised vectors exceed half a turn


def rigid(rotation: ArrayLike, translation: ArrayLike) -> NDArray[np.float64]:
    """The matrix ``[4, 4]`` of a rotation ``[3, 3]``, or a vector ``[3]`` in radians, and a translation ``[3]``."""
    turned, moved = np.array(rotation, dtype=np.float64), np.array(translation, dtype=np.float64).reshape(-1)
    if turned.size == 3:
        if (length := float(np.linalg.norm(turned))) > FULL_TURN:
            raise Unreadable(f"a rotation vector of length {length:g}, more than a turn in radians; are these degrees?")
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
    cross = cross_matrices(vector / angle)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def intrinsics(fx: Any, fy: Any, cx: Any, cy: Any) -> NDArray[np.float64]:
    """The matrix ``[3, 3]`` of focal lengths and principal point, pixels."""
    fx, fy, cx, cy = map(number, (fx, fy, cx, cy))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def calibrated_camera(name: str, *, viewmat: ArrayLike, K: ArrayLike, size: tuple[int, int], where: Path) -> Camera:
    """One camera of the calibration file ``where``.

    Args:
        viewmat: ``[4, 4]`` or ``[3, 4]``, world to camera, OpenCV axes.
        K: ``[3, 3]`` intrinsics, pixels.
        size: width and height of the pictures, pixels.

    Raises:
        CalibrationError: invalid values (see :class:`Camera`), a pose written by columns, or a principal point for a
            picture of another size.
    """
    try:
        pose = np.array(viewmat, dtype=np.float64)
        if pose.shape == (3, 4):
            pose = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
        camera = Camera(from_numpy(pose), from_numpy(np.array(K, dtype=np.float64)), *size)
        check_matrices(camera)
    except CalibrationError as error:
        raise CalibrationError(f"Camera {name!r} of {where}: {error}") from None
    except BROKEN as error:
        raise CalibrationError(
            f"Camera {name!r} of {where} has a matrix that cannot be read ({reason(error)}); "
            "expected rows of numbers, a 3x3 K and a 4x4 pose."
        ) from None
    cx, cy = camera.K[:2, 2].tolist()
    across, down = cx / camera.width, cy / camera.height
    # A wrong picture size moves both ratios the same way; a crop seldom does.
    if not (0 < across < 1 and 0 < down < 1) or max(across, down) < 0.3 or min(across, down) > 0.7:
        raise CalibrationError(
            f"Camera {name!r} of {where}: the principal point ({cx:.1f}, {cy:.1f}) does not belong to a picture of "
            f"{camera.width}x{camera.height} pixels; scale the intrinsics to the picture's size."
        )
    return camera


def at_picture_size(camera: Camera, size: tuple[int, int], *, name: str, where: Path) -> Camera:
    """``camera`` of the calibration ``where`` for its pictures of ``size``, width and height: a uniform reduction.

    Raises:
        CalibrationError: the pictures have other proportions, so what was cropped is unknown.
    """
    width, height = size
    if abs(height - camera.height * width / camera.width) > 1:
        raise CalibrationError(
            f"The pictures of camera {name!r} have {width}x{height} pixels, {where} is for "
            f"{camera.width}x{camera.height}: other proportions, so they are not a reduction; use pictures of the mode "
            "that was calibrated, or calibrate it."
        )
    return camera.resized(width, height)


def calibrated_rig(
    cameras: Mapping[str, Camera], held_out: Collection[str], *, where: Path, near: float | None = None
) -> CameraRig:
    """The rig of a capture; ``near`` (capture units) defaults to 0.12 times the rig's radius.

    Raises:
        CalibrationError: fewer than two training cameras, an unknown held-out one, or cameras without poses of their
            own, naming ``where``.
    """
    try:
        rig = CameraRig(dict(cameras), frozenset(held_out))
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from None
    check_poses(cameras, where=where)
    return with_near(rig, NEAR_IN_RIG_RADII * rig_radius(rig) if near is None else near)


def check_poses(cameras: Mapping[str, Camera], *, where: Path) -> None:
    """Check that every camera has a pose of its own; tools write zeros for what they did not calibrate.

    Raises:
        CalibrationError: two have the same pose, or all stand at one place, naming ``where``.
    """
    named: dict[bytes, str] = {}  # by pose
    for name, camera in cameras.items():
        if (other := named.setdefault((camera.viewmat.numpy() + 0.0).tobytes(), name)) != name:
            raise CalibrationError(
                f"{where}: cameras {other!r} and {name!r} have the same pose, as of cameras whose lenses alone were "
                "calibrated; calibrate where they stand, or leave one out."
            )
    try:
        check_places([*cameras.values()])
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from None


def with_near(rig: CameraRig, near: float) -> CameraRig:
    """The same rig with the near plane of every camera at ``near``, capture units."""
    return rig.mapped({name: replace(rig[name], near=near) for name in rig})


class NoPose(Exception):
    """A file has no pose of a camera, since it was not calibrated with the others."""


@dataclass(frozen=True)
class CalibrationFormat:
    """The calibration files of a tool."""

    find: Callable[[Path], Iterator[tuple[Path, ...]]]
    """Gives the sets of files in a folder that are a calibration of the tool each."""
    entries: Callable[[tuple[Path, ...]], Iterable[tuple[str, Any]]]
    """Gives the cameras of such a set by name, with what the files state of them."""
    camera: Callable[[str, Any], PosedCamera]  # makes the camera of an entry
    expected: str  # what the files contain, for messages
    turned_by_exif: bool | None = None  # see :class:`Calibration`
    where: Callable[[tuple[Path, ...]], Path] = operator.itemgetter(0)  # gives the file or folder that messages name

    def read(self, files: tuple[Path, ...]) -> Calibration:
        """The cameras of a set of files.

        Raises:
            CalibrationError: a file is missing or broken, or a camera has a model that is not known here.
        """
        where = self.where(files)
        with readable(where, self.expected):
            entries = list(self.entries(files))
        calibration = calibration_of(entries, self.camera, file=where, expected=self.expected)
        return replace(calibration, turned_by_exif=self.turned_by_exif)


def common_folder(files: tuple[Path, ...]) -> Path:
    """The one file, or the folder of several."""
    return files[0] if len(files) == 1 else Path(os.path.commonpath(files))


def calibration_of(
    entries: Iterable[tuple[str, Entry]], read: Callable[[str, Entry], PosedCamera], *, file: Path, expected: str
) -> Calibration:
    """The cameras of a file, in its order; those without a pose are left out with a warning.

    Raises:
        CalibrationError: an entry is broken, naming its camera; or there is none, or none with a pose.
    """
    cameras, unposed = [], []
    for name, entry in entries:
        try:
            with readable(f"Camera {name!r} of {file}", expected):
                camera = read(name, entry)
                if not (np.isfinite(camera.viewmat).all() and np.isfinite(camera.K).all()):
                    raise Unreadable("a number that is not finite (NaN or infinity)")
            cameras.append(camera)
        except NoPose:
            unposed.append(name)
    if not cameras:
        found = f"no pose of {listed(unposed)}" if unposed else "no cameras"
        raise CalibrationError(f"{file} holds {found}; expected {expected}.")
    if unposed:
        log.warning("%s has no pose of %s; left out", file, listed(unposed))
    return Calibration(file, tuple(cameras), unposed=tuple(unposed))


def check_held_out(held_out: Collection[str], cameras: Collection[str], *, where: Path) -> None:
    """Check that the cameras to hold out are among those of the file ``where``.

    Raises:
        CalibrationError: one is not.
    """
    if isinstance(held_out, str):
        raise CalibrationError(f"{where} holds out {held_out!r}; expected a list of names, [{held_out!r}].")
    if unknown := [name for name in held_out if name not in cameras]:
        raise CalibrationError(
            f"{where} holds out {listed(unknown)}, which it does not have; its cameras are {', '.join(cameras)}."
        )


def check_names(calibrated: Collection[str], pictured: Collection[str], *, calibration: Path, pictures: Path) -> None:
    """Check that the calibrated cameras are those with pictures.

    Raises:
        CalibrationError: pictures of a camera without calibration.
        CaptureError: a calibrated camera without pictures.
    """
    if unknown := [name for name in pictured if name not in calibrated]:
        raise CalibrationError(
            f"{pictures} has pictures of {listed(unknown)}, for which {calibration} has no calibration; "
            "calibrate them, or move their pictures out of the capture."
        )
    if missing := [name for name in calibrated if name not in pictured]:
        raise CaptureError(
            f"{calibration} calibrates {listed(missing)}, but {pictures} has no pictures of them; "
            "add the pictures, or remove the cameras from the calibration."
        )


def listed(names: Collection[str], limit: int = 5) -> str:
    """``camera 'a'`` or ``cameras 'a', 'b' and 3 more``, for messages."""
    shown = ", ".join(repr(name) for name in list(names)[:limit])
    rest = f" and {len(names) - limit} more" if len(names) > limit else ""
    return f"camera{'s' if len(names) > 1 else ''} {shown}{rest}"


@dataclass(frozen=True)
class Alignment:
    """``aligned = scale * rotation @ point + translation``."""

    scale: float  # positive
    rotation: Floats  # ``[3, 3]``
    translation: Floats  # ``[3]``

    def points(self, points: Floats) -> Floats:
        """Points ``[..., 3]``, aligned."""
        return self.scale * points @ self.rotation.T + self.translation

    def camera(self, camera: Camera) -> Camera:
        """A camera that sees the aligned points where ``camera`` sees the points."""
        viewmat = camera.viewmat.clone()
        turned = camera.viewmat[:3, :3] @ from_numpy(self.rotation.T.copy())
        viewmat[:3, :3] = turned
        viewmat[:3, 3] = self.scale * camera.viewmat[:3, 3] - turned @ from_numpy(self.translation)
        return replace(camera, viewmat=viewmat, near=camera.near * self.scale)

    def filmed(self, filmed: LensCamera) -> LensCamera:
        """:meth:`camera` of a camera with a lens."""
        return LensCamera(self.camera(filmed.camera), filmed.lens)


def alignment(theirs: Mapping[str, Floats], ours: Mapping[str, Floats]) -> Alignment:
    """The similarity from ``theirs`` to ``ours``, world-to-camera matrices ``[4, 4]`` of the same names.

    The rotation is that of the cameras' axes, since positions alone do not give it when cameras stand in a line; scale
    and translation are least squares of the positions (Umeyama, PAMI 1991). Cameras that all stand at one place leave
    the scale at 1.
    """
    turns = sum(ours[name][:3, :3].T @ theirs[name][:3, :3] for name in theirs)
    u, _, vh = np.linalg.svd(turns)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh
    from_, to = (np.array([-poses[name][:3, :3].T @ poses[name][:3, 3] for name in theirs]) for poses in (theirs, ours))
    turned = (from_ - from_.mean(0)) @ rotation.T
    spread = float((turned**2).sum())
    scale = float((turned * (to - to.mean(0))).sum() / spread) if spread > 0 else 1.0
    return Alignment(scale, rotation, to.mean(0) - scale * rotation @ from_.mean(0))
