# SPDX-License-Identifier: Apache-2.0
"""The camera chain of Kalibr: ``camchain.yaml``, pinholes with radtan or equidistant distortion.

``T_cn_cnm1`` maps the axes of the camera before to this one's; the world is the first camera. Metres. Other keys, as
those of an IMU, are of no camera.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration_files.opencv_storage import parsed_yaml
from structgstream.data.calibration_files.reading import LARGEST_BYTES, calibration_of, readable
from structgstream.data.lenses import Lens, Pinhole, fisheye_lens, from_integer_centers, opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, intrinsics
from structgstream.data.text_files import Unreadable, mapping, pixels, read_text
from structgstream.errors import CalibrationError

EXPECTED = (
    "cam0, cam1, ... with camera_model, intrinsics, distortion_model, distortion_coeffs, resolution and T_cn_cnm1"
)
CAMERA = re.compile(r"cam\d+")
CHAIN = re.compile(r"^cam\d+\s*:[\s\S]*\bT_cn_cnm1\b|^cam\d+\s*:[\s\S]*\bcamera_model\b", re.MULTILINE)


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """The YAML files with a chain of cameras, or named as one; those of an IMU alone are none."""
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() in (".yaml", ".yml") and file.is_file() and file.stat().st_size < LARGEST_BYTES:
            try:
                if "camchain" in file.stem or CHAIN.search(read_text(file)):
                    yield (file,)
            except (OSError, Unreadable):
                continue  # no file of Kalibr


def read(files: tuple[Path, ...]) -> Calibration:
    """The cameras of the chain.

    Raises:
        CalibrationError: the file is broken, or a camera has a model that is not known here.
        MissingExtraError: PyYAML is not installed.
    """
    (file,) = files
    with readable(file, EXPECTED):
        content = mapping(parsed_yaml(read_text(file)))
        names = [str(name) for name in content if CAMERA.fullmatch(str(name))]
        entries = [(name, content[name]) for name in sorted(names, key=lambda name: int(name.removeprefix("cam")))]
    viewmat = np.eye(4)

    def camera(name: str, entry: Any) -> PosedCamera:
        nonlocal viewmat
        entry = mapping(entry)
        if name != entries[0][0]:
            viewmat = np.array(entry["T_cn_cnm1"], dtype=np.float64).reshape(4, 4) @ viewmat
        K = from_integer_centers(intrinsics(*entry["intrinsics"]))
        return PosedCamera(name, viewmat, K, pixels(entry["resolution"]), _lens(name, entry, file))

    return calibration_of(entries, camera, file=file, expected=EXPECTED)


def _lens(name: str, entry: dict[str, Any], file: Path) -> Lens:
    models = {"radtan": opencv_lens, "equidistant": fisheye_lens, "none": lambda _: Pinhole()}
    model = str(entry["camera_model"]), str(entry.get("distortion_model", "none"))
    if model[0] != "pinhole" or model[1] not in models:
        raise CalibrationError(
            f"Camera {name!r} of {file} is of the model {model[0]}-{model[1]}, which is not known here; calibrate it "
            "as pinhole-radtan or pinhole-equi."
        )
    return models[model[1]](entry.get("distortion_coeffs") or ())
