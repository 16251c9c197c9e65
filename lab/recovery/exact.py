# SPDX-License-Identifier: Apache-2.0
"""What a recovered calibration costs a stream: the same pictures with the true one.

``python -m lab.recovery.exact PREPARED CAPTURE --work build/exact --frames 4 --json lab/results/exact.json``
compares a capture that ``structgstream prepare`` wrote with the calibrated capture whose pictures were given to it:
errors of cameras after a similarity, and the held-out scores of two streams made with the same settings from
the same files, one with the recovered calibration and one with the true one.

Note [Resampled alike]: a picture that is resampled half a pixel beside its own grid is smoother, and a smoother picture
is easier to predict. Pinholes of a recovered camera lie on the grid of its own pictures; the same pinholes lie half a
pixel beside that of the true camera where its principal point does, which made streams of a path-traced scene 1.2 dB
better than those of the pictures as they are. So the pinhole of a true camera is to it as the recovered one's is to
that one.
"""

import argparse
import json
import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from lab.recovery.recovery import camera_errors, plain, summary
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import open_capture
from structgstream.data.points import initial_points
from structgstream.data.prepared import PreparedCamera, open_prepared, read_prepared, write_prepared
from structgstream.data.timeline import Clock
from structgstream.preparation.calibration.solved import rig_alignment
from structgstream.preparation.footage import find_footage
from structgstream.session.presets import PRESETS, StreamConfig

SEED_POINTS = "points.npy"


def write_exact(
    capture: Path,
    folder: Path,
    cameras: Mapping[str, LensCamera],
    clocks: Mapping[str, Clock],
    *,
    own_pinholes: bool = False,
) -> None:
    """Writes the prepared capture with the true calibration, in the prepared one's coordinates and common time.

    Files, near plane and the way in which initial points are found are the same, and so are pinholes.

    Args:
        capture: the prepared one.
        folder: to write; replaced.
        cameras: the true ones, in any coordinates.
        clocks: the true ones.
        own_pinholes: for lenses without distortion, whether pinholes are on the true cameras' own grids (Note
            [Resampled alike]).
    """
    content = read_prepared(capture)
    shutil.rmtree(folder, ignore_errors=True)
    both = {name: cameras[name] for name in content.cameras}
    moved = rig_alignment(both, {name: camera.filmed for name, camera in content.cameras.items()})
    shifted = with_common_zero(clocks, {name: camera.clock for name, camera in content.cameras.items()})
    exact = {}
    for name, camera in content.cameras.items():
        filmed = moved.filmed(both[name])
        pinhole = replace(camera.pinhole, viewmat=filmed.camera.viewmat)
        if own_pinholes:
            pinhole = replace(pinhole, K=resampled_alike(filmed.camera.K, camera))
        exact[name] = replace(camera, filmed=filmed, pinhole=pinhole, clock=shifted[name])
        _link((capture / camera.files).resolve(), folder / camera.files)
    written = replace(content, cameras=exact, points=None)
    write_prepared(folder, written)
    source = open_prepared(folder)
    np.save(folder / SEED_POINTS, initial_points(next(source.frames(0)), source.rig))
    write_prepared(folder, replace(written, points=SEED_POINTS))


def resampled_alike(K: Tensor, camera: PreparedCamera) -> Tensor:
    """Intrinsics that are to ``K`` as those of the prepared camera's pinhole are to its own."""
    own, pinhole, found = camera.filmed.camera.K, camera.pinhole.K, K.clone()
    found[[0, 1], [0, 1]] *= pinhole[[0, 1], [0, 1]] / own[[0, 1], [0, 1]]
    found[:2, 2] += pinhole[:2, 2] - own[:2, 2]
    return found


def with_common_zero(truth: Mapping[str, Clock], estimate: Mapping[str, Clock]) -> dict[str, Clock]:
    """The true clocks, with the zero of the estimated common time."""
    shift = float(np.median([clock.offset_seconds - truth[name].offset_seconds for name, clock in estimate.items()]))
    return {name: replace(truth[name], offset_seconds=truth[name].offset_seconds + shift) for name in estimate}


def stream_scores(
    capture: Path, path: Path, *, preset: StreamConfig | str, frames: int, scale: float = 1.0, start: int = 0
) -> dict[str, float | None]:
    """Mean scores of a short stream, made at ``path``, over its frames and the cameras that the capture holds out."""
    from structgstream.api import evaluate, reconstruct

    reconstruct(capture, path, preset=preset, frames=frames, scale=scale, start=start, overwrite=True)
    mean = evaluate(path, capture, metrics="basic").mean
    return {"psnr": mean.psnr, "psnr_camera_color": mean.psnr_camera_color, "psnr_changed": mean.psnr_changed}


def compared(options: argparse.Namespace) -> dict[str, Any]:
    """Errors of the recovered cameras and clocks, and the scores of both streams."""
    content = read_prepared(options.prepared)
    truth = open_capture(options.capture).rig
    cameras = {name: LensCamera(truth[name], Pinhole()) for name in content.cameras}
    clocks = true_clocks(options.phones, tuple(content.cameras))
    footage = find_footage(options.footage)
    takes = {name: (float(footage.stamps(name)[0]), float(footage.stamps(name)[-1])) for name in content.cameras}
    errors = camera_errors(
        {name: camera.filmed for name, camera in content.cameras.items()},
        cameras,
        clocks={name: camera.clock for name, camera in content.cameras.items()},
        true_clocks=clocks,
        takes=takes,
    )
    options.work.mkdir(parents=True, exist_ok=True)
    exact = options.work / "exact"
    write_exact(options.prepared, exact, cameras, clocks, own_pinholes=True)
    settings = {"preset": options.preset, "frames": options.frames, "scale": options.scale, "start": options.start}
    scores = {
        kind: stream_scores(folder, options.work / f"{kind}.sgs", **settings)
        for kind, folder in {"prepared": options.prepared, "exact": exact}.items()
    }
    return {"errors": summary(errors), "cameras": plain(errors), "scores": scores, "settings": settings}


def true_clocks(phones: Path | None, cameras: tuple[str, ...]) -> dict[str, Clock]:
    """Clocks that are in step, or those of ``truth.json`` of ``lab/phones``."""
    if phones is None:
        return dict.fromkeys(cameras, Clock())
    said = json.loads(phones.read_text())["phones"]
    return {name: Clock(said[name]["offset_seconds"]) for name in cameras}


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    os.symlink(source, target, target_is_directory=source.is_dir())


def main() -> None:
    """Compares, prints the result and writes it."""
    from benchmarks.machine import machine

    parser = argparse.ArgumentParser(
        prog="python -m lab.recovery.exact", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("prepared", type=Path, help="what structgstream prepare wrote")
    parser.add_argument("capture", type=Path, help="the calibrated capture of the same cameras")
    parser.add_argument("--footage", type=Path, required=True, help="the videos or pictures that were prepared")
    parser.add_argument("--phones", type=Path, help="truth.json of lab/phones; without it the cameras are in step")
    parser.add_argument("--work", type=Path, required=True, help="folder for the exact capture and the streams")
    parser.add_argument("--preset", default="fast", choices=sorted(PRESETS))
    parser.add_argument("--frames", type=int, default=4, help="of each stream")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    command = " ".join(["python -m lab.recovery.exact", *sys.argv[1:]])
    result = {"command": command, "machine": machine()} | compared(options)
    for kind, error in result["errors"].items():
        print(kind, error)
    print(json.dumps(result["scores"], indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
