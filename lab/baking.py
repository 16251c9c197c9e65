# SPDX-License-Identifier: Apache-2.0
"""How close baked Gaussians come to the scene that they were made of, for every choice in question (docs/export.md).

``python -m lab.baking STREAM CAPTURE --frame N`` prints a table of PSNR in dB: of the baked Gaussians against
the scene's own rendering and against the truth, over the training cameras and over those held out. "Left out" is a
second baking, without every fourth training camera, scored in those cameras against the scene.
"""

import argparse
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # Read once, when torch loads OpenMP.

from structgstream.codec.reader import open_stream
from structgstream.data.wrappers import select_cameras
from structgstream.evaluation.evaluate import rendered
from structgstream.evaluation.metrics import decibels, mean_of_squares, squared_errors
from structgstream.evaluation.recording import capture_of
from structgstream.evaluation.scoring import Picture
from structgstream.exporters.bake import BakingConfig, bake
from structgstream.kernels.backend import select_backend
from structgstream.scene.state import on_device


def choices(center: BakingConfig) -> list[BakingConfig]:
    """The values around ``center``, one choice changed at a time."""
    found = [replace(center, degree=degree) for degree in (0, 1, 2)]
    found += [replace(center, ridge=ridge) for ridge in (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1) if ridge != center.ridge]
    found += [replace(center, degree=2, ridge=ridge) for ridge in (1e-5, 1e-3, 1e-2, 1e-1) if ridge != center.ridge]
    found += [replace(center, opacity="drawn" if center.opacity == "seen" else "seen")]
    found += [replace(center, shape="covariance" if center.shape == "parts" else "parts")]
    return [*found, replace(center, weight="blend" if center.weight == "opacity" else "opacity")]


def psnr(picture: Picture, truth: Picture) -> float:
    """Peak signal-to-noise ratio of two 8-bit pictures, dB."""
    errors = squared_errors(picture, truth)
    return decibels(mean_of_squares(int(errors.sum(dtype="int64")), errors.size))


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(prog="python -m lab.baking", description=__doc__)
    parser.add_argument("stream", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the rows to measure")
    options = parser.parse_args()
    backend = select_backend("auto")
    reader = open_stream(options.stream, by_index=True)
    scene = on_device(reader.scene(options.frame), backend.device)
    rig = reader.header.rig
    views = {name: reader.header.camera(name) for name in rig}
    frames = select_cameras(capture_of(reader.header, options.capture, frames=None), tuple(rig)).frames()
    truths = next(frame for number, frame in enumerate(frames) if number == options.frame).images
    own = {name: rendered(scene, views[name], backend)[0] for name in rig}
    sides = {"training": rig.training, "held out": rig.testing}
    left_out = rig.training[1::4]

    def row(text: str, pictures: dict[str, Picture], others: dict[str, Picture]) -> None:
        cells = [f"{sum(psnr(others[name], own[name]) for name in left_out) / len(left_out):.2f}"]
        for names in sides.values():
            to_own = [psnr(pictures[name], own[name]) for name in names]
            to_truth = [psnr(pictures[name], truths[name]) for name in names]
            cells += [f"{sum(values) / len(values):.2f}" for values in (to_own, to_truth)]
        print(f"| {text} | {' | '.join(cells)} |", flush=True)

    def pictures(names: tuple[str, ...], choice: BakingConfig, of: tuple[str, ...]) -> tuple[dict[str, Picture], int]:
        plain = bake(scene, [views[name] for name in names], backend, baking=choice)
        return {name: rendered(plain, views[name], backend)[0] for name in of}, len(plain)

    print("| choice | left out | training, to the scene | to the truth | held out, to the scene | to the truth |")
    print("|---|---|---|---|---|---|")
    row("the scene", own, own)
    for number, choice in enumerate(choices(BakingConfig())):
        if options.only is None or number in options.only:
            others, _ = pictures(tuple(name for name in rig.training if name not in left_out), choice, left_out)
            found, count = pictures(rig.training, choice, tuple(rig))
            text = f"degree {choice.degree}, ridge {choice.ridge:g}, {choice.opacity}, {choice.shape}, {choice.weight}"
            row(f"{text}; {count:,}", found, others)


if __name__ == "__main__":
    main()
