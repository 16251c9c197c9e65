# SPDX-License-Identifier: Apache-2.0
"""What calibration recovers of a capture whose calibration is given: blind, or from that calibration perturbed.

    python lab/recovery/calibration.py CAPTURE --instants 0 15 30 45
    python lab/recovery/calibration.py CAPTURE --instants 0 15 30 45 --refine

Errors are those of ``tests/support/calibration_errors.py``: median and largest over the cameras.
"""

import argparse
import resource
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.data.calibration import rotation_matrix
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import open_capture
from structgstream.preparation.calibration.structure import refine, solve_structure
from tests.support.calibration_errors import CameraError, calibration_errors, radius_of

Rig = Mapping[str, LensCamera]


def main(arguments: Sequence[str] | None = None) -> None:
    options = _options(arguments)
    given, pictures = _read(options.capture, options.instants)
    cpu, wall = time.process_time(), time.perf_counter()
    if options.refine:
        start = perturbed(given, degrees=options.degrees, percent=options.percent)
        _print("perturbed", calibration_errors(start, given).values())
        found = refine(pictures, start)
        print(f"held back {found.held_out}: {found.before_pixels:.2f} to {found.after_pixels:.2f} pixels")
        solved = found.solved
    else:
        solved = solve_structure(pictures, lens=options.lens)
    _print("found", calibration_errors(solved.cameras, given).values())
    print(
        f"placed {len(solved.cameras)} of {len(given)}, {len(solved.points)} points, {len(solved.observations)} "
        f"observations, median error {np.nanmedian(solved.errors()):.2f} pixels"
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{time.process_time() - cpu:.0f} CPU s, {time.perf_counter() - wall:.0f} s, peak {peak:.0f} MB")


def perturbed(rig: Rig, *, degrees: float, percent: float, seed: int = 0) -> dict[str, LensCamera]:
    """Every camera turned by ``degrees``, moved by ``percent`` of the rig's radius and zoomed by ``percent``."""
    generator = np.random.default_rng(seed)
    radius = radius_of(rig)
    found = {}
    for name, filmed in rig.items():
        axis, step = (vector / np.linalg.norm(vector) for vector in generator.normal(size=(2, 3)))
        viewmat, K = filmed.camera.viewmat.clone(), filmed.camera.K.clone()
        viewmat[:3] = torch.from_numpy(rotation_matrix(axis * np.radians(degrees))) @ viewmat[:3]
        viewmat[:3, 3] += torch.from_numpy(step * percent / 100 * radius)
        K[[0, 1], [0, 1]] *= 1 + percent / 100 * generator.choice([-1, 1])
        found[name] = replace(filmed, camera=replace(filmed.camera, viewmat=viewmat, K=K))
    return found


def _read(capture: Path | None, instants: Sequence[int]) -> tuple[Rig, dict[str, list[NDArray[np.uint8]]]]:
    source = bundled_clip() if capture is None else open_capture(capture)
    pictures: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in source.rig}
    for frame in source.frames():
        if frame.index in instants:
            for name in source.rig:
                pictures[name].append(frame.images[name])
        if frame.index >= max(instants):
            break
    return {name: LensCamera(source.rig[name], Pinhole()) for name in source.rig}, pictures


def _print(title: str, errors: Iterable[CameraError]) -> None:
    figures: dict[str, Callable[[CameraError], float]] = {
        "rotation, degrees": lambda error: error.rotation_degrees,
        "position, % of radius": lambda error: error.position_percent,
        "focal length, %": lambda error: abs(error.focal_percent),
        "lens, pixels": lambda error: error.lens_pixels,
    }
    found = list(errors)
    for name, figure in figures.items():
        values = [figure(error) for error in found]
        print(f"{title:10} {name:22} median {np.median(values):.3f}, largest {max(values):.3f}")


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path, nargs="?", help="a calibrated capture; the bundled clip without one")
    parser.add_argument("--instants", type=int, nargs="+", default=[0])
    parser.add_argument("--lens", default="pinhole", choices=["pinhole", "radial", "opencv", "fisheye"])
    parser.add_argument("--refine", action="store_true", help="from the given calibration, perturbed")
    parser.add_argument("--degrees", type=float, default=0.3)
    parser.add_argument("--percent", type=float, default=1.0)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
