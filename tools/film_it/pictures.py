# SPDX-License-Identifier: Apache-2.0
"""The pictures of docs/film-it.md: ``python tools/film_it/pictures.py docs/images``.

Checks the bundled clip as it is, and with the pose of ``cam04`` turned by 0.6 degrees, and takes the pictures from the
two reports.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import cv2
import numpy as np

from structgstream.data.calibration import rotation_matrix
from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.preparation.prepare import check_folder

TURNED, DEGREES = "cam04", 0.6
QUALITY, WIDEST = 82, 1000
FINE = {"camera_0.png": "camera", "coverage.png": "coverage", "lines_1.png": "lines"}
OFF = {"camera_4.png": "camera-off", "pairs.png": "pairs"}


def turned_clip(folder: Path) -> Path:
    """A copy of the bundled clip whose calibration has one camera turned about its y axis."""
    shutil.copytree(bundled_clip_path(), folder)
    file = folder / "cameras.json"
    content = json.loads(file.read_text())
    camera = content["cameras"][TURNED]
    turn = np.eye(4)
    turn[:3, :3] = rotation_matrix(np.radians([0.0, DEGREES, 0.0]))
    camera["viewmat"] = (turn @ np.array(camera["viewmat"])).tolist()
    file.write_text(json.dumps(content))
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", type=Path)
    images = parser.parse_args().images
    with tempfile.TemporaryDirectory() as temporary:
        captures = {bundled_clip_path(): FINE, turned_clip(Path(temporary) / "turned"): OFF}
        for number, (capture, pictures) in enumerate(captures.items()):
            report = Path(temporary) / f"report{number}"
            check_folder(capture, report=report)
            for file, name in pictures.items():
                picture = cv2.imread(str(report / file))
                assert picture is not None, f"the report has no {file}"
                scale = min(1.0, WIDEST / picture.shape[1])
                small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(images / f"film-it-{name}.webp"), small, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
