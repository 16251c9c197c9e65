# SPDX-License-Identifier: Apache-2.0
"""The PanopticSports layout of Dynamic 3D Gaussians (Luiten et al., 3DV 2024).

``train_meta.json`` and ``test_meta.json`` hold ``w``, ``h`` and, per frame and camera, ``k``, ``w2c`` (OpenCV
world to camera), ``fn`` (file below ``ims/``) and ``cam_id``. The cameras of ``test_meta.json`` are held out.
"""

from pathlib import Path
from typing import Any

import numpy as np

from structgstream.cameras import Camera
from structgstream.data.calibration import calibrated_camera, calibrated_rig
from structgstream.data.calibration_files.reading import readable
from structgstream.data.images import PICTURE_SUFFIXES, ImageSource, common_pictures
from structgstream.data.text_files import NamedFiles, mapping, path_parts, pixels, read_json
from structgstream.data.timeline import natural
from structgstream.errors import CalibrationError, CaptureError

PANOPTIC_FPS = 30000 / 1001
TRAIN, TEST = "train_meta.json", "test_meta.json"


def recognizes_panoptic(path: Path) -> bool:
    """Whether the folder has this layout."""
    return (path / TRAIN).is_file()


def open_panoptic(path: Path) -> ImageSource:
    """The capture at ``path``.

    Raises:
        CaptureError: a file is not what the layout asks for, or a camera has no pictures.
        CalibrationError: broken numbers, or a camera that moves.
    """
    cameras: dict[str, Camera] = {}
    files: dict[str, dict[str, Path]] = {}
    held_out: list[str] = []
    for meta in (path / TRAIN, path / TEST):
        if not meta.is_file():
            continue
        found, pictures = _read_meta(meta)
        if both := sorted(found.keys() & cameras.keys(), key=natural):
            raise CaptureError(f"Camera {both[0]!r} is in both {TRAIN} and {TEST} of {path}; keep it in one.")
        cameras |= found
        files |= pictures
        if meta.name == TEST:
            held_out += found
    names = sorted(cameras, key=natural)
    rig = calibrated_rig({name: cameras[name] for name in names}, held_out, where=path)
    common = common_pictures({name: files[name] for name in names}, where=path, training=rig.training)
    return ImageSource(path.name, rig, PANOPTIC_FPS, common.files, instants=common.instants)


def _read_meta(meta: Path) -> tuple[dict[str, Camera], dict[str, dict[str, Path]]]:
    """Cameras of one file, and those pictures of each that exist, by the name of the instant."""
    with readable(meta, "w, h, k, w2c, fn and cam_id, the last four as lists over frames and cameras"):
        content = mapping(read_json(meta))
        width, height = pixels((content["w"], content["h"]))
        pictures = NamedFiles(meta.parent / "ims", PICTURE_SUFFIXES)
        rows = [
            (str(name), K, viewmat, _picture(pictures, str(file)), file)
            for frame in zip(content["cam_id"], content["k"], content["w2c"], content["fn"], strict=True)
            for name, K, viewmat, file in zip(*frame, strict=True)
        ]
    first: dict[str, tuple[Any, Any]] = {}
    files: dict[str, dict[str, Path]] = {name: {} for name, *_ in rows}
    for name, K, viewmat, picture, file in rows:
        known = first.setdefault(name, (K, viewmat))
        if known != (K, viewmat) and not _same(known, (K, viewmat)):
            raise CalibrationError(
                f"Camera {name!r} of {meta} moves: its k or w2c changes at {file}; expected cameras that stand still."
            )
        if picture is not None:
            files[name][picture.stem] = picture
    cameras = {
        name: calibrated_camera(name, viewmat=viewmat, K=K, width=width, height=height, where=meta)
        for name, (K, viewmat) in first.items()
    }
    return cameras, files


def _picture(pictures: NamedFiles, text: str) -> Path | None:
    """The picture of a path below ``ims``, which may name that and what is above it."""
    return pictures.find(text) or pictures.find("/".join(path_parts(text)[-2:]))


def _same(a: tuple[Any, Any], b: tuple[Any, Any]) -> bool:
    """Whether two pairs of matrices agree up to rounding; NaN agrees with NaN, which the camera refuses."""
    try:
        return all(
            np.allclose(np.array(x, float), np.array(y, float), rtol=1e-6, atol=1e-9, equal_nan=True)
            for x, y in zip(a, b)
        )
    except (TypeError, ValueError):
        return False
