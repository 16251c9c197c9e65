# SPDX-License-Identifier: Apache-2.0
"""The camera chain of Kalibr: ``camchain.yaml``, pinholes with radtan or equidistant distortion.

``T_cn_cnm1`` maps the axes of the camera before to this one's; the world is the first camera. Metres.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration_files.reading import each_camera, readable
from structgstream.data.lenses import Lens, Pinhole, fisheye_lens, from_integer_centers, opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, intrinsics
from structgstream.errors import CalibrationError, MissingExtraError

EXPECTED = (
    "cam0, cam1, ... with camera_model, intrinsics, distortion_model, distortion_coeffs, resolution and T_cn_cnm1"
)


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """The YAML files named as a chain of cameras."""
    named = (file for file in sorted(folder.iterdir()) if file.suffix in (".yaml", ".yml") and "chain" in file.stem)
    return ((file,) for file in named)


def read(files: tuple[Path, ...]) -> Calibration:
    """The cameras of the chain.

    Raises:
        CalibrationError: the file is broken, or a camera has a model that is not known here.
        MissingExtraError: PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError:
        raise MissingExtraError("yaml", "capture") from None
    (file,) = files
    with readable(file, EXPECTED):
        try:
            content = yaml.safe_load(file.read_text())
        except yaml.YAMLError as error:
            raise ValueError(" ".join(str(error).split())) from None
        entries = [(name, content[name]) for name in sorted(content, key=lambda name: int(name.removeprefix("cam")))]
    viewmat = np.eye(4)

    def camera(name: str, entry: dict[str, Any]) -> PosedCamera:
        nonlocal viewmat
        if name != entries[0][0]:
            viewmat = np.array(entry["T_cn_cnm1"], dtype=np.float64).reshape(4, 4) @ viewmat
        width, height = entry["resolution"]
        lens = _lens(name, entry, file)
        return PosedCamera(name, viewmat, from_integer_centers(intrinsics(*entry["intrinsics"])), (width, height), lens)

    return Calibration(file, each_camera(entries, camera, file=file, expected=EXPECTED))


def _lens(name: str, entry: dict[str, Any], file: Path) -> Lens:
    models = {"radtan": opencv_lens, "equidistant": fisheye_lens, "none": lambda _: Pinhole()}
    model = entry["camera_model"], entry.get("distortion_model", "none")
    if model[0] != "pinhole" or model[1] not in models:
        raise CalibrationError(
            f"Camera {name!r} of {file} is of the model {model[0]}-{model[1]}, which is not known here; calibrate it "
            "as pinhole-radtan or pinhole-equi."
        )
    return models[model[1]](entry.get("distortion_coeffs", ()))
