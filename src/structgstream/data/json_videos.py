# SPDX-License-Identifier: Apache-2.0
"""Folders with ``cameras.json`` and one video per camera, in two dialects.

The package's own, which the bundled clip uses: ``{"width", "height", "fps", "frames", "near", "held_out":
[names], "cameras": {name: {"K": 3x3, "viewmat": 4x4 world to camera}}}`` with ``name.mp4``.

The shared-intrinsics one: ``{"w", "h", "fl_x", "fl_y", "cx", "cy", "cams": [4x4 camera to world, ...]}`` with
``cam00.mp4``, ``cam01.mp4``, ... in the order of ``cams``; camera 0 is held out.

Both in OpenCV axes.
"""

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.cameras import Camera, CameraRig
from structgstream.data.calibration import calibrated_camera, calibrated_rig, check_names
from structgstream.data.calibration_files.reading import positive, readable
from structgstream.data.camera_files import roots_of, videos_in
from structgstream.data.source import FrameSource
from structgstream.data.text_files import mapping, pixels, read_json, whole
from structgstream.data.timeline import natural
from structgstream.data.video import VideoSource, synchronised
from structgstream.data.video_index import scan_videos
from structgstream.errors import CaptureError

FILE = "cameras.json"


def recognizes_json_videos(path: Path) -> bool:
    """Whether the folder has this layout."""
    return (path / FILE).is_file()


def open_json_videos(path: Path) -> VideoSource:
    """The capture at ``path``.

    Raises:
        CaptureError: ``cameras.json`` or a video cannot be read, or they do not belong together.
        CalibrationError: broken numbers.
    """
    file = path / FILE
    rig, fps, stated_frames = read_cameras(file)
    videos = next(filter(None, map(videos_in, roots_of(path))), {})
    check_names(list(rig), sorted(videos, key=natural), calibration=file, pictures=path)
    source = synchronised(scan_videos({name: videos[name] for name in rig}), rig, where=path, fps=fps)
    if len(source) < stated_frames:
        raise CaptureError(
            f"The videos of {path} share {len(source)} frames, {FILE} states {stated_frames}; "
            "copy the capture again or correct the number."
        )
    return source


def read_cameras(file: Path) -> tuple[CameraRig, float | None, int]:
    """The rig of a ``cameras.json``, its frames a second (None if not stated) and the number of frames.

    Raises:
        CalibrationError: the file cannot be read, or has broken numbers.
    """
    with readable(file, "width, height and cameras with K and viewmat, or w, h, fl_x, fl_y, cx, cy and cams"):
        content = mapping(read_json(file))
        rig = _own_rig(content, file) if "cameras" in content else _shared_intrinsics_rig(content, file)
        return rig, positive(content, "fps") if "fps" in content else None, whole(content.get("frames", 1))


def _own_rig(content: dict[str, Any], file: Path) -> CameraRig:
    width, height = pixels((content["width"], content["height"]))
    cameras = {
        name: calibrated_camera(name, viewmat=entry["viewmat"], K=entry["K"], width=width, height=height, where=file)
        for name, entry in mapping(content["cameras"]).items()
    }
    near = positive(content, "near") if "near" in content else None
    return calibrated_rig(cameras, content.get("held_out", ()), where=file, near=near)


def _shared_intrinsics_rig(content: dict[str, Any], file: Path) -> CameraRig:
    K = [[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]]
    width, height = pixels((content["w"], content["h"]))
    cameras: dict[str, Camera] = {}
    for number, pose in enumerate(content["cams"]):
        name = f"cam{number:02d}"
        with readable(f"Camera {name!r} of {file}", "a pose of 4x4 numbers that can be inverted"):
            viewmat = np.linalg.inv(np.array(pose, dtype=np.float64).reshape(4, 4))
        cameras[name] = calibrated_camera(name, viewmat=viewmat, K=K, width=width, height=height, where=file)
    return calibrated_rig(cameras, ("cam00",), where=file)


def bundled_clip_path() -> Path:
    """The folder of the bundled clip.

    Raises:
        CaptureError: the installation lacks the clip.
    """
    folder = Path(str(files("structgstream.data") / "clip"))
    if not recognizes_json_videos(folder):
        raise CaptureError("The bundled clip is missing from the installation; reinstall structgstream.")
    return folder


def bundled_clip() -> FrameSource:
    """The bundled clip, as a capture."""
    return open_json_videos(bundled_clip_path())
