# SPDX-License-Identifier: Apache-2.0
"""Prepared captures: ``capture.json`` next to the original videos or pictures (docs/captures.md).

Nothing is stored undistorted or in step: lenses and clocks are applied as frames are read, so that a capture can be
calibrated again without touching what was filmed. A broken file is a ``CalibrationError``, one that is missing a
``CaptureError``.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_write
from structgstream.cameras import Camera, CameraRig
from structgstream.data.calibration import calibrated_camera, calibrated_rig, check_held_out
from structgstream.data.camera_files import by_stem, files_of
from structgstream.data.images import PICTURE_SUFFIXES, ImageSource, picture_size
from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole, RadialTangential
from structgstream.data.source import FrameSource
from structgstream.data.text_files import Unreadable, mapping, number, pixels, positive, read_array, read_json, readable
from structgstream.data.timeline import Clock, natural, paired, picture_slots
from structgstream.data.undistortion import undistorted_to
from structgstream.data.video import synchronised
from structgstream.data.video_index import scan_videos
from structgstream.errors import CalibrationError, CaptureError

FILE = "capture.json"
ROVING = "roving"  # section of the file and folder of the pictures; programs that do not know it train without
FORMAT, VERSION = "structgstream-capture", 1
EXPECTED = "a capture that structgstream prepare wrote (docs/captures.md)"
LENSES: Mapping[str, type[Lens]] = {"pinhole": Pinhole, "opencv": RadialTangential, "fisheye": Fisheye}

Unit = Literal["metres", "arbitrary"]


@dataclass(frozen=True)
class PreparedCamera:
    """A camera of a prepared capture."""

    files: str  # its video, or the folder of its pictures, relative to the capture
    filmed: LensCamera  # pose, intrinsics, size and lens of the pictures as they are stored
    pinhole: Camera  # what they are undistorted to; its pose is that of ``filmed``
    clock: Clock = Clock()  # from the stamps of the file to the time that all cameras share


@dataclass(frozen=True)
class PreparedCapture:
    """The content of ``capture.json``."""

    cameras: Mapping[str, PreparedCamera]  # by name
    fps: float  # frames a second of the common timeline
    near: float  # near plane, in the capture's units
    unit: Unit = "arbitrary"  # of poses and points; ``arbitrary`` where no length was given
    held_out: frozenset[str] = field(default_factory=frozenset)  # names of the held-out cameras
    points: str | None = None  # file of points ``[P, 3]`` (``.npy``) relative to the capture, or None
    sound: str | None = None  # camera of the best microphone; None where none has sound
    roving: Mapping[str, PreparedCamera] = field(default_factory=dict)  # frames of a roving camera (data/roving.py)

    def only(self, names: Collection[str]) -> "PreparedCapture":
        """These cameras, in the order of the capture, without points."""
        cameras = {name: camera for name, camera in self.cameras.items() if name in names}
        return replace(self, cameras=cameras, held_out=self.held_out.intersection(names), points=None)


def recognizes_prepared(path: Path) -> bool:
    """Whether the folder is a prepared capture."""
    return (path / FILE).is_file()


def write_prepared(path: Path, capture: PreparedCapture) -> None:
    """Writes ``capture.json`` into the folder ``path``, whole or not at all."""
    atomic_write(path / FILE, (json.dumps(prepared_entries(capture), indent=1) + "\n").encode())


def prepared_entries(capture: PreparedCapture) -> dict[str, Any]:
    """What ``capture.json`` holds."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "fps": capture.fps,
        "unit": capture.unit,
        "near": capture.near,
        "held_out": sorted(capture.held_out, key=natural),
        "points": capture.points,
        **({"sound": capture.sound} if capture.sound is not None else {}),
        "cameras": {name: _entry(camera) for name, camera in capture.cameras.items()},
        **({ROVING: {name: _entry(camera) for name, camera in capture.roving.items()}} if capture.roving else {}),
    }


def _entry(camera: PreparedCamera) -> dict[str, Any]:
    pinhole = {"size": [camera.pinhole.width, camera.pinhole.height], "K": camera.pinhole.K.tolist()}
    return {"files": camera.files, **filmed_entry(camera.filmed), "clock": asdict(camera.clock), "pinhole": pinhole}


def read_prepared(path: Path) -> PreparedCapture:
    """The content of ``capture.json`` in the folder ``path``."""
    file = path / FILE
    with readable(file, EXPECTED):
        content: dict[str, Any] = read_json(file)
        if content["format"] != FORMAT or content["version"] != VERSION:
            raise CalibrationError(
                f"{file} has format {content['format']!r}, version {content['version']}; this program reads "
                f"{FORMAT!r}, version {VERSION}: prepare the capture again, or update structgstream."
            )
        entries = mapping(content["cameras"])
        if content["unit"] not in ("metres", "arbitrary"):
            raise Unreadable(f"unit {content['unit']!r}")
        cameras = {name: _read_camera(name, entry, file) for name, entry in entries.items()}
        check_held_out(content["held_out"], cameras, where=file)
        return PreparedCapture(
            cameras=cameras,
            fps=positive(content, "fps"),
            near=positive(content, "near"),
            unit=cast(Unit, content["unit"]),
            held_out=frozenset(content["held_out"]),
            points=None if content["points"] is None else str(content["points"]),
            sound=str(content["sound"]) if content.get("sound") in entries else None,
            roving={name: _read_camera(name, entry, file) for name, entry in mapping(content.get(ROVING, {})).items()},
        )


def open_prepared(path: Path) -> FrameSource:
    """The capture at ``path``: in step by its clocks, undistorted to its pinholes."""
    capture = read_prepared(path)
    rig = filmed_rig(path, capture)
    files = {name: path / camera.files for name, camera in capture.cameras.items()}
    if missing := [f"{file} of camera {name!r}" for name, file in files.items() if not file.exists()]:
        raise CaptureError(f"{missing[0]} is missing; restore it, or prepare the capture again.")
    points = _read_points(path, capture)
    if all(file.is_dir() for file in files.values()):
        source: FrameSource = _of_folders(path, files, rig, capture, points)
    else:
        clocks = {name: camera.clock for name, camera in capture.cameras.items()}
        source = synchronised(scan_videos(files), rig, where=path, fps=capture.fps, points=points, clocks=clocks)
    return undistorted(source, path, capture)


def undistorted(source: FrameSource, path: Path, capture: PreparedCapture) -> FrameSource:
    """Pictures of :func:`filmed_rig` for the pinholes of the capture; the source itself if that changes nothing."""
    filmed = {name: camera.filmed for name, camera in capture.cameras.items()}
    return undistorted_to(prepared_rig(path, capture), source, filmed)


def filmed_rig(path: Path, capture: PreparedCapture) -> CameraRig:
    """The rig of the pictures before undistortion."""
    where = file if (file := path / FILE).is_file() else path
    cameras = {name: camera.filmed.camera for name, camera in capture.cameras.items()}
    return calibrated_rig(cameras, capture.held_out, where=where, near=capture.near)


def prepared_rig(path: Path, capture: PreparedCapture) -> CameraRig:
    """The rig of the prepared capture at ``path``: what its pictures are undistorted to."""
    filmed = filmed_rig(path, capture)
    return filmed.mapped({name: replace(capture.cameras[name].pinhole, near=capture.near) for name in filmed})


def camera_of(viewmat: Any, K: Any, size: Sequence[int]) -> Camera:
    """A camera from plain numbers; a ``ValueError`` for those of other shapes."""
    width, height = pixels(size)
    pose = torch.from_numpy(np.array(viewmat, np.float64).reshape(4, 4))
    return Camera(pose, torch.from_numpy(np.array(K, np.float64).reshape(3, 3)), width, height)


def pictures_of(folder: Path) -> tuple[Path, ...]:
    """The pictures of a camera's folder, in the order of their names."""
    return tuple(sorted(by_stem(files_of(folder, PICTURE_SUFFIXES)).values(), key=lambda file: natural(file.stem)))


def _of_folders(
    path: Path, files: Mapping[str, Path], rig: CameraRig, capture: PreparedCapture, points: NDArray[np.float64] | None
) -> ImageSource:
    """Folders of pictures that are counted at the capture's rate, in step by their clocks as videos are."""
    found = {name: pictures_of(folder) for name, folder in files.items()}
    if empty := [name for name, pictures in found.items() if not pictures]:
        raise CaptureError(f"The folder {files[empty[0]]} of camera {empty[0]!r} has no pictures; restore them.")
    slots = picture_slots(found)
    seconds = {name: capture.cameras[name].clock.common_seconds(slots[name] / capture.fps) for name in found}
    frames, apart = paired(seconds, fps=capture.fps, where=str(path), training=rig.training)
    cut = {}
    for name, pictures in found.items():
        cut[name] = tuple(None if frame is None else pictures[frame] for frame in frames[name])
        size, own = picture_size(pictures[0]), (rig[name].width, rig[name].height)
        if size != own:
            raise CalibrationError(
                f"The pictures of camera {name!r} in {files[name]} have {size[0]}x{size[1]} pixels, {path / FILE} is "
                f"for {own[0]}x{own[1]}; restore them, or prepare the capture again."
            )
    return ImageSource(path.name, rig, capture.fps, cut, points, apart_seconds=apart)


def _read_points(path: Path, capture: PreparedCapture) -> NDArray[np.float64] | None:
    if capture.points is None:
        return None
    file = path / capture.points
    with readable(file, "points as an array of shape [P, 3]"):
        points = read_array(file)
        if points.ndim != 2 or points.shape[1] != 3:
            raise Unreadable(f"an array of shape {points.shape}")
    return points


def filmed_entry(filmed: LensCamera) -> dict[str, Any]:
    """A camera with its lens as plain values."""
    camera, lens = filmed.camera, filmed.lens
    model = next(model for model, kind in LENSES.items() if isinstance(lens, kind))
    return {
        "size": [camera.width, camera.height],
        "K": camera.K.tolist(),
        "lens": {"model": model, **asdict(lens)},
        "viewmat": camera.viewmat.tolist(),
    }


def _read_camera(name: str, entry: dict[str, Any], file: Path) -> PreparedCamera:
    with readable(f"Camera {name!r} of {file}", EXPECTED):
        filmed = calibrated_camera(name, viewmat=entry["viewmat"], K=entry["K"], size=pixels(entry["size"]), where=file)
        parameters = {key: number(value) for key, value in entry["lens"].items() if key != "model"}
        kind = LENSES[entry["lens"]["model"]]
        if unknown := parameters.keys() - {own.name for own in fields(kind)}:  # type: ignore[arg-type]
            raise Unreadable(f"a lens with {min(unknown)}")
        lens = kind(**parameters)
        try:  # Its principal point may lie anywhere.
            pinhole = camera_of(entry["viewmat"], entry["pinhole"]["K"], entry["pinhole"]["size"])
        except CalibrationError as error:
            raise CalibrationError(f"The pinhole of camera {name!r} of {file}: {error}") from None
        clock = Clock(number(entry["clock"]["offset_seconds"]), positive(entry["clock"], "rate"))
        return PreparedCamera(str(entry["files"]), LensCamera(filmed, lens), pinhole, clock)
