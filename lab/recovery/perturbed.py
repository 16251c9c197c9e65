# SPDX-License-Identifier: Apache-2.0
"""A calibration that is a little off, for ``structgstream prepare --calibration FILE --refine``.

``python -m lab.recovery.perturbed CAPTURE perturbed.json`` turns, moves and zooms every camera of a calibrated capture,
at random but the same for the same seed, and writes the result as multical does.
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lab.recovery.calibration import perturbed
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import open_capture


def multical(cameras: Mapping[str, LensCamera]) -> dict[str, Any]:
    """The ``calibration.json`` of cameras without distortion."""
    described, poses = {}, {}
    for name, filmed in cameras.items():
        camera = filmed.camera
        K = camera.K.numpy().copy()
        K[:2, 2] -= 0.5  # multical counts from the centre of the first pixel
        size = [camera.width, camera.height]
        described[name] = {"model": "standard", "image_size": size, "K": K.tolist(), "dist": [[0.0] * 5]}
        poses[name] = {"R": camera.viewmat[:3, :3].tolist(), "T": camera.viewmat[:3, 3].tolist()}
    return {"cameras": described, "camera_poses": poses}


def main(arguments: list[str] | None = None) -> None:
    """Writes the file."""
    parser = argparse.ArgumentParser(
        prog="python -m lab.recovery.perturbed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("capture", type=Path, help="a calibrated capture without distortion")
    parser.add_argument("file", type=Path, help="JSON to write")
    parser.add_argument("--degrees", type=float, default=0.3, help="by which every camera is turned")
    parser.add_argument("--percent", type=float, default=1.0, help="of the rig's radius, and of the focal length")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    rig = open_capture(options.capture).rig
    given = {name: LensCamera(rig[name], Pinhole()) for name in rig}
    found = perturbed(given, degrees=options.degrees, percent=options.percent, seed=options.seed)
    options.file.write_text(json.dumps(multical(found), indent=1) + "\n")


if __name__ == "__main__":
    main()
