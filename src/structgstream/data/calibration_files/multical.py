# SPDX-License-Identifier: Apache-2.0
"""The ``calibration.json`` of multical.

``cameras``: ``image_size``, ``K``, ``dist`` (OpenCV's order) by name; ``camera_poses``: ``R`` and ``T`` by name, or by
``NAME_to_OTHER``. Poses map the rig, or the other camera's axes, to the camera's: despite the name of the second form.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.calibration_files.reading import NoPose, calibration_of, json_files_with, readable
from structgstream.data.lenses import from_integer_centers, opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, rigid
from structgstream.data.text_files import Unreadable, mapping, pixels, read_json

EXPECTED = "cameras with image_size, K and dist, and camera_poses with R and T, as multical writes it"


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """The JSON files with camera poses."""
    return json_files_with(folder, "camera_poses")


def read(files: tuple[Path, ...]) -> Calibration:
    """The cameras of the file that have a pose.

    Raises:
        CalibrationError: it is broken.
    """
    (file,) = files
    with readable(file, EXPECTED):
        content = read_json(file)
        poses = _absolute(content["camera_poses"])
        entries = [(name, entry) for name, entry in mapping(content["cameras"]).items()]
    return calibration_of(entries, partial(_camera, poses), file=file, expected=EXPECTED)


def _absolute(entries: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    """World to camera by name; each relative pose after the one that it refers to."""
    poses: dict[str, NDArray[np.float64]] = {}
    waiting = mapping(entries)
    while waiting:
        ready = {key: key.split("_to_") for key in waiting if "_to_" not in key or key.split("_to_")[1] in poses}
        if not ready:
            raise Unreadable(f"the poses {', '.join(waiting)} refer to no camera that has one")
        for key, (name, *other) in ready.items():
            pose = mapping(waiting.pop(key))
            viewmat = rigid(pose["R"], pose["T"])
            poses[name] = viewmat @ poses[other[0]] if other else viewmat
    return poses


def _camera(poses: Mapping[str, NDArray[np.float64]], name: str, entry: dict[str, Any]) -> PosedCamera:
    if name not in poses:
        raise NoPose
    return PosedCamera(
        name=name,
        viewmat=poses[name],
        K=from_integer_centers(entry["K"]),
        size=pixels(entry["image_size"]),
        lens=opencv_lens(np.ravel(entry["dist"]).tolist()),
    )
