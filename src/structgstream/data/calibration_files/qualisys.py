# SPDX-License-Identifier: Apache-2.0
"""The ``.qca.txt`` of Qualisys: XML, millimetres, lengths on the sensor in 1/64 pixel; here metres and pixels.

``transform`` turns the world to axes x right, y up, z backward, which are turned half around x. The sensor counts
from its border, so that the top-left pixel's centre is (0.5, 0.5) as here; distortion is in OpenCV's order and
without a unit.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from structgstream.data.calibration_files.reading import calibration_of, readable
from structgstream.data.lenses import opencv_lens
from structgstream.data.posed import Calibration, PosedCamera, intrinsics
from structgstream.data.text_files import Unreadable, number, pixels
from structgstream.errors import CalibrationError

EXPECTED = "cameras of video with fov_video, transform and intrinsic, as Qualisys Track Manager exports it"
METRES = 0.001
SUBPIXELS = 64
VIDEO_MODELS = ("video", "none")


def find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """Such files, each alone."""
    return ((file,) for file in sorted(folder.glob("*.qca.txt")))


def read(files: tuple[Path, ...]) -> Calibration:
    """The video cameras of the file.

    Raises:
        CalibrationError: it is broken, or its pictures are turned.
    """
    (file,) = files
    with readable(file, EXPECTED):
        try:
            found = ET.fromstring(file.read_bytes()).iter("camera")
        except ET.ParseError as error:
            raise Unreadable(f"it is not XML at line {error.position[0]}") from None
        video = [tag for tag in found if any(word in tag.get("model", "none").lower() for word in VIDEO_MODELS)]
        entries = [(tag.attrib["serial"], tag) for tag in video]
    for serial, tag in entries:
        if (turned := tag.get("viewrotation", "0")) != "0":
            raise CalibrationError(
                f"Camera {serial!r} of {file} has pictures that are turned by {turned} degrees, and its calibration is "
                "for those that are not; set the view rotation to 0 and export again."
            )
    return calibration_of(entries, _camera, file=file, expected=EXPECTED)


def _camera(name: str, tag: ET.Element) -> PosedCamera:
    view, pose, optics = (_attributes(tag, child) for child in ("fov_video", "transform", "intrinsic"))
    rotation = np.array([[pose[f"r{row}{column}"] for column in (1, 2, 3)] for row in (1, 2, 3)])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ np.array([pose["x"], pose["y"], pose["z"]]) * METRES
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0]) @ viewmat
    fx, fy, cx, cy = (
        optics[key] / SUBPIXELS for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    radial = [optics[f"radialDistortion{term}"] for term in (1, 2)]
    tangential = [optics[f"tangentalDistortion{term}"] for term in (1, 2)]  # the file's spelling
    return PosedCamera(
        name=name,
        viewmat=viewmat,
        K=intrinsics(fx, fy, cx - view["left"], cy - view["top"]),
        size=pixels((view["right"] - view["left"] + 1, view["bottom"] - view["top"] + 1)),
        lens=opencv_lens([*radial, *tangential, optics.get("radialDistortion3", 0.0)]),
    )


def _attributes(tag: ET.Element, child: str) -> dict[str, float]:
    found = tag.find(child)
    if found is None:
        raise KeyError(child)
    return {key: number(value) for key, value in found.attrib.items()}
