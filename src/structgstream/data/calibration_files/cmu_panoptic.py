# SPDX-License-Identifier: Apache-2.0
"""The ``calibration_SEQUENCE.json`` of the CMU Panoptic Studio, in centimetres; here they become metres.

``cameras`` is a list with ``name`` (panel_node), ``type`` (hd, vga, kinect-color), ``resolution``, ``K``,
``distCoef`` (OpenCV's order), ``R`` and ``t``, world to camera. Videos are ``hdVideos/hd_00_00.mp4``, pictures
``hdImgs/00_00/00_00_00000000.jpg``.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration_files.reading import calibration_of, json_files_with, readable
from structgstream.data.lenses import from_integer_centers, opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, rigid
from structgstream.data.text_files import pixels, read_json

EXPECTED = "a list of cameras with name, type, resolution, K, distCoef, R and t, as the Panoptic Studio has it"
METRES = 0.01


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """The JSON files with such cameras."""
    return json_files_with(folder, "distCoef")


def read(files: tuple[Path, ...]) -> Calibration:
    """The cameras of the file.

    Raises:
        CalibrationError: it is broken.
    """
    (file,) = files
    with readable(file, EXPECTED):
        entries = [(str(entry["name"]), entry) for entry in read_json(file)["cameras"]]
    return calibration_of(entries, _camera, file=file, expected=EXPECTED)


def _camera(name: str, entry: dict[str, Any]) -> PosedCamera:
    return PosedCamera(
        name=f"{entry['type']}_{name}/{name}",  # of a video, or of a folder
        viewmat=rigid(entry["R"], METRES * np.array(entry["t"], dtype=np.float64)),
        K=from_integer_centers(entry["K"]),
        size=pixels(entry["resolution"]),
        lens=opencv_lens(np.ravel(entry["distCoef"]).tolist()),
    )
