# SPDX-License-Identifier: Apache-2.0
"""The calibration of live cameras: that of a capture, applied to pictures that arrive."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.calibration import calibrated_rig
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.masks import FOLDER, with_masks
from structgstream.data.open import open_capture, selected
from structgstream.data.prepared import PreparedCamera, PreparedCapture, read_prepared, recognizes_prepared
from structgstream.data.source import FrameSource
from structgstream.data.undistortion import UndistortedSource
from structgstream.data.wrappers import SourceWrapper
from structgstream.frames import MultiViewFrame


@dataclass(frozen=True)
class LivePictures:
    """Pictures as cameras sent them, as a capture, so that the wrappers of captures apply to them.

    Args:
        name: of the stream.
        rig: the cameras of the stored pictures.
        fps: frames a second.
        arriving: frames in the order of their arrival.
    """

    name: str
    rig: CameraRig
    fps: float
    arriving: Iterator[MultiViewFrame]
    points: NDArray | None = None

    def __len__(self) -> int:
        """0: the number is unknown."""
        return 0

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        return self.arriving


def read_calibration(folder: Path) -> PreparedCapture:
    """Lenses and pinholes of the cameras of a capture of any layout.

    Raises:
        CaptureError: it cannot be opened. A prepared capture needs its ``capture.json`` alone.
    """
    if recognizes_prepared(folder):
        return read_prepared(folder)
    source = open_capture(folder)
    lenses = _lenses(source)
    rig = source.rig
    cameras = {
        name: PreparedCamera(name, lenses.get(name, LensCamera(rig[name], Pinhole())), rig[name]) for name in rig
    }
    near = min(rig[name].near for name in rig)
    return PreparedCapture(cameras, source.fps, near, "arbitrary", rig.held_out)


def select_cameras(capture: PreparedCapture, names: Sequence[str]) -> PreparedCapture:
    """The calibration restricted to these cameras, in its order."""
    return PreparedCapture(
        {name: camera for name, camera in capture.cameras.items() if name in names},
        capture.fps,
        capture.near,
        capture.unit,
        capture.held_out.intersection(names),
    )


def filmed_rig(capture: PreparedCapture, folder: Path) -> CameraRig:
    """The rig of the pictures before undistortion."""
    return _rig({name: camera.filmed.camera for name, camera in capture.cameras.items()}, capture, folder)


def filmed_sizes(capture: PreparedCapture) -> dict[str, tuple[int, int]]:
    """Width and height of each camera's pictures before undistortion, pixels."""
    return {name: (own.filmed.camera.width, own.filmed.camera.height) for name, own in capture.cameras.items()}


def with_calibration(
    pictures: FrameSource,
    capture: PreparedCapture,
    folder: Path,
    *,
    held_out: tuple[str, ...] | None,
    scale: float,
    near: float | None,
) -> FrameSource:
    """Live pictures undistorted and masked as those of a prepared capture are.

    Args:
        pictures: those of :func:`filmed_rig`.
        capture: the calibration.
        folder: where it was read.
        held_out: see ``open_capture``.
        scale: see ``open_capture``.
        near: see ``open_capture``.

    Raises:
        CaptureError: masks that do not fit.
        ConfigError: an invalid option.
    """
    pinholes = _rig({name: camera.pinhole for name, camera in capture.cameras.items()}, capture, folder)
    filmed = {name: camera.filmed for name, camera in capture.cameras.items()}
    undistorted = UndistortedSource(pictures, pinholes, filmed)
    source = pictures if all(undistorted.is_unchanged(name) for name in pinholes) else undistorted
    return selected(with_masks(source, folder / FOLDER), held_out=held_out, scale=scale, near=near)


def _lenses(source: FrameSource) -> Mapping[str, LensCamera]:
    while isinstance(source, SourceWrapper):
        if isinstance(source, UndistortedSource):
            return source.filmed
        source = source.source
    return {}


def _rig(cameras: Mapping[str, Camera], capture: PreparedCapture, folder: Path) -> CameraRig:
    return calibrated_rig(cameras, capture.held_out, where=folder, near=capture.near)
