# SPDX-License-Identifier: Apache-2.0
"""The TOML of aniposelib, which anipose, caliscope, Pose2Sim and FreeMoCap write.

A table per camera with ``name``, ``size`` (width, height), ``matrix``, ``distortions`` (OpenCV's order), ``rotation``
(vector, or matrix, world to camera), ``translation`` and ``fisheye``. The unit is that of the board that was filmed.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration_files.reading import NoPose, calibration_of, readable
from structgstream.data.lenses import fisheye_lens, from_integer_centers, opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, rigid
from structgstream.data.text_files import pixels, read_toml

EXPECTED = "a table per camera with name, size, matrix, distortions, rotation and translation, as aniposelib writes it"


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """The TOML files that have tables of cameras, or are named as if they had."""
    for file in sorted(folder.glob("*.toml")):
        try:
            if _tables(read_toml(file)):
                yield (file,)
        except (OSError, ValueError):
            if "calib" in file.stem.lower():
                yield (file,)


def read(files: tuple[Path, ...]) -> Calibration:
    """The cameras of the file.

    Raises:
        CalibrationError: it is broken.
    """
    (file,) = files
    with readable(file, EXPECTED):
        tables = _tables(read_toml(file))
    return calibration_of(tables.items(), _camera, file=file, expected=EXPECTED)


def _tables(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Tables of cameras by name, at the top or below ``cameras``."""
    inner = content.get("cameras", content)
    tables = inner.items() if isinstance(inner, dict) else ()
    return {
        str(table.get("name", key)): table for key, table in tables if isinstance(table, dict) and "matrix" in table
    }


def _camera(name: str, table: dict[str, Any]) -> PosedCamera:
    if "rotation" not in table and "translation" not in table:
        raise NoPose
    coefficients = np.ravel(table["distortions"]).tolist()
    return PosedCamera(
        name=name,
        viewmat=rigid(table["rotation"], table["translation"]),
        K=from_integer_centers(table["matrix"]),
        size=pixels(table["size"]),
        lens=(fisheye_lens if table.get("fisheye") else opencv_lens)(coefficients),
    )
