# SPDX-License-Identifier: Apache-2.0
"""``intri.yml`` and ``extri.yml`` of EasyMocap and EasyVolcap, as ENeRF-Outdoor and others are given.

``names``; for each name ``K_``, ``dist_`` or ``D_`` (OpenCV's order), sometimes ``H_`` and ``W_``; ``R_`` (vector) or
``Rot_`` (matrix) and ``T_``, world to camera.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration_files.opencv_storage import read_storage
from structgstream.data.calibration_files.reading import calibration_of, readable
from structgstream.data.lenses import from_integer_centers, opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, rigid
from structgstream.data.text_files import number, pixels

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
EXPECTED = "names, K_NAME and D_NAME in intri.yml, and R_NAME or Rot_NAME and T_NAME in extri.yml"


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """The two files, when the first is there."""
    if (folder / INTRINSICS).is_file():
        yield (folder / INTRINSICS, folder / EXTRINSICS)


def read(files: tuple[Path, ...]) -> Calibration:
    """The cameras of the two files.

    Raises:
        CalibrationError: one is missing or broken.
    """
    content: dict[str, Any] = {}
    for file in files:
        with readable(file, EXPECTED):
            content |= read_storage(file)
        names = [str(name) for name in content.get("names") or ()]
    if not all(f"K_{name}" in content for name in names):  # YAML reads 00 as a number
        names = [key.removeprefix("K_") for key in content if key.startswith("K_")]
    return calibration_of(((name, name) for name in names), partial(_camera, content), file=files[0], expected=EXPECTED)


def _camera(content: dict[str, Any], name: str, _: str) -> PosedCamera:
    coefficients = content.get(f"D_{name}", content.get(f"dist_{name}"))
    turned = content[f"Rot_{name}"] if f"Rot_{name}" in content else content[f"R_{name}"]
    size = (content.get(f"W_{name}", -1), content.get(f"H_{name}", -1))
    return PosedCamera(
        name=name,
        viewmat=rigid(turned, content[f"T_{name}"]),
        K=from_integer_centers(content[f"K_{name}"]),
        size=pixels(size) if min(map(number, size)) > 0 else None,
        lens=opencv_lens([] if coefficients is None else np.ravel(coefficients).tolist()),
    )
