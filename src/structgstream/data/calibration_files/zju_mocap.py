# SPDX-License-Identifier: Apache-2.0
"""The ``annots.npy`` of ZJU-MoCap, in millimetres; here they become metres.

It is a pickle, which could run any program, so it is read by :mod:`.plain_pickle`, which knows arrays and nothing
else. ``cams`` holds lists ``K``, ``D`` (OpenCV's order), ``R`` and ``T``, world to camera; ``ims`` the pictures of
each instant, ``CAMERA/FRAME.jpg`` in the order of the cameras.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration_files.plain_pickle import load_plain
from structgstream.data.calibration_files.reading import calibration_of, readable
from structgstream.data.lenses import from_integer_centers, opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, rigid

EXPECTED = "a dictionary with cams (lists K, D, R and T) and ims, as ZJU-MoCap has it"
METRES = 0.001


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """``annots.npy``."""
    file = folder / "annots.npy"
    if file.is_file():
        yield (file,)


def read(files: tuple[Path, ...]) -> Calibration:
    """The cameras of the file.

    Raises:
        CalibrationError: it is broken, or holds something else than arrays.
    """
    (file,) = files
    with readable(file, EXPECTED):
        content: dict[str, Any] = np.asarray(load_plain(file)).item()
        cams = content["cams"]
        rows = zip(content["ims"][0]["ims"], cams["K"], cams["D"], cams["R"], cams["T"], strict=True)
        entries = [(str(picture), row) for picture, *row in rows]
    return calibration_of(entries, _camera, file=file, expected=EXPECTED)


def _camera(name: str, row: list[Any]) -> PosedCamera:
    K, distortion, rotation, translation = row
    viewmat = rigid(rotation, METRES * np.asarray(translation, dtype=np.float64))
    return PosedCamera(name, viewmat, from_integer_centers(K), None, opencv_lens(np.ravel(distortion).tolist()))
