# SPDX-License-Identifier: Apache-2.0
"""What a roving video gives: poses against the truth, and held-out PSNR of frame 0, with and without it.

    python -m lab.recovery.roving film build/roving --cameras 4 6 8
    python -m lab.recovery.roving poses build/roving --cameras 8 --walk empty --json poses.json
    python -m lab.recovery.roving psnr build/roving --cameras 8 --walk empty --seeds 0 --json psnr.json
    python -m lab.recovery.roving basketball build/roving --capture basketball --cameras 4 --json psnr.json

Walks are ``none``, ``empty`` (filmed while nobody is in the room) and ``people`` (while two people walk). Held-out
cameras stand half-way between the cameras; they have their true poses, in the coordinates of the prepared capture.

There is no roving video of basketball: pictures of its other training cameras, each of another instant, stand in for
one, with their given poses. So nothing is registered there, and only the views of frame 0 and their masks are tried.
"""

import argparse
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lab.recovery.roving_room import FPS, covered, film, phone, rig
from structgstream import evaluate, reconstruct
from structgstream.codec.reader import open_stream
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import open_capture
from structgstream.data.prepared import PreparedCamera, PreparedCapture, read_prepared, write_prepared
from structgstream.data.roving import WithRoving
from structgstream.data.undistortion import Undistortion, rectilinear
from structgstream.errors import CaptureError
from structgstream.kernels.backend import select_backend
from structgstream.preparation.calibration.solved import rig_alignment
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.prepare import prepare_capture
from structgstream.scene.render import render_picture
from tests.support.calibration_errors import calibration_errors, radius_of

HELD_OUT = ("0", "10", "15", "30")  # of basketball


def prepared(folder: Path, count: int, walk: str) -> tuple[Path, str]:
    """The capture of ``count`` cameras and what preparing said."""
    capture = folder / f"{count}-{walk}"
    options = PrepareOptions(synchronize="none", fps=FPS, roving=None if walk == "none" else folder / f"{walk}.mp4")
    made = prepare_capture(folder / str(count) / "videos", capture, options=options)
    return capture, made.steps["calibrate"]


def poses(folder: Path, count: int, walk: str) -> dict[str, Any]:
    """Errors of the still cameras and of the phone, which take one similarity by the still cameras."""
    begun = time.process_time()
    try:
        capture, said = prepared(folder, count, walk)
    except CaptureError as error:
        return {"refused": str(error), "seconds": time.process_time() - begun}
    found, truth = read_prepared(capture), rig(count)
    estimated = {name: camera.filmed for name, camera in found.cameras.items()}
    result = {"said": said, "seconds": time.process_time() - begun, "cameras": _errors(estimated, truth)}
    if found.roving:
        alignment = rig_alignment(estimated, truth)
        radius = radius_of(truth)
        frames = {name: (alignment.filmed(own.filmed), phone(_frame(name))) for name, own in found.roving.items()}
        degrees = [_angle(one, other) for one, other in frames.values()]
        away = [float((one.camera.center - other.camera.center).norm()) / radius for one, other in frames.values()]
        result["roving"] = {
            "frames": len(frames),
            "degrees": [float(np.median(degrees)), max(degrees)],
            "percent": [100 * float(np.median(away)), 100 * max(away)],
        }
    return result


def _errors(estimated: Mapping[str, LensCamera], truth: Mapping[str, LensCamera]) -> dict[str, list[float]]:
    errors = calibration_errors(estimated, truth).values()
    values = {
        "degrees": [error.rotation_degrees for error in errors],
        "percent": [error.position_percent for error in errors],
        "focal_percent": [abs(error.focal_percent) for error in errors],
        "lens_pixels": [error.lens_pixels for error in errors],
    }
    return {kind: [float(np.median(own)), max(own)] for kind, own in values.items()}


def _angle(one: LensCamera, other: LensCamera) -> float:
    turn = (one.camera.viewmat[:3, :3] @ other.camera.viewmat[:3, :3].T).numpy()
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))


def _frame(name: str) -> int:
    return int(name.rsplit("/", 1)[-1])


def scored_capture(folder: Path, count: int, walk: str) -> Path:
    """The prepared capture with the held-out cameras, at their true poses."""
    capture, _ = prepared(folder, count, walk)
    target = folder / f"{count}-{walk}-scored"
    if not target.exists():
        shutil.copytree(capture, target, symlinks=True)
    content = read_prepared(capture)
    tests = rig(count, between=True)
    alignment = rig_alignment(rig(count), {name: own.filmed for name, own in content.cameras.items()})
    cameras = dict(content.cameras)
    for name, filmed in tests.items():
        moved = alignment.filmed(filmed)
        files = target / "pictures" / name
        shutil.copytree(folder / str(count) / "tests" / name, files, dirs_exist_ok=True)
        cameras[name] = PreparedCamera(f"pictures/{name}", moved, rectilinear(moved))
    write_prepared(target, replace(content, cameras=cameras, held_out=frozenset(tests)))
    return target


def psnr(folder: Path, count: int, walk: str, *, without: bool, seed: int, preset: str) -> dict[str, Any]:
    """Scores of frame 0 at the held-out cameras; ``without`` leaves the roving pictures out and takes their poses."""
    capture = scored_capture(folder, count, walk)
    scores = _scores(capture, folder / "room.sgs", without=without, seed=seed, preset=preset, scale=1.0)
    return {**scores, **_split_psnr(capture, folder / "room.sgs", count)}


def _split_psnr(capture: Path, stream: Path, count: int) -> dict[str, float]:
    """Mean PSNR of the held-out cameras where people are in frame 0 (and two pixels around), and elsewhere."""
    content, frame = read_prepared(capture), next(open_capture(capture, frames=1).frames())
    found: dict[str, list[float]] = {"psnr_people": [], "psnr_still": []}
    with open_stream(stream) as reader:
        scene = reader.scene(0)
        for name, filmed in rig(count, between=True).items():
            camera = content.cameras[name]
            people = (
                Undistortion(camera.filmed, camera.pinhole)(np.repeat(covered(filmed)[..., None], 3, -1))[..., 0] > 0
            )
            drawn = render_picture(scene, reader.header.camera(name), select_backend("cpu"))
            errors = ((drawn.astype(float) - frame.images[name]) ** 2).mean(2)
            for kind, mask in (("psnr_people", people), ("psnr_still", ~people)):
                found[kind].append(float(-10 * np.log10(errors[mask].mean() / 255**2)))
    return {kind: float(np.mean(own)) for kind, own in found.items()}


def _scores(capture: Path, stream: Path, *, without: bool, seed: int, preset: str, scale: float) -> dict[str, Any]:
    begun = time.process_time()
    (report,) = reconstruct(
        capture,
        stream,
        preset=preset,
        frames=1,
        seed=seed,
        scale=scale,
        roving=not without,
        overwrite=True,
        backend="cpu",
    )
    seconds = time.process_time() - begun
    scores = evaluate(stream, capture, metrics="basic", backend="cpu").mean
    return {
        "psnr": scores.psnr, "psnr_camera_color": scores.psnr_camera_color, "train_psnr": report.train_psnr,
        "anchors": report.anchors, "seconds": seconds,
    }  # fmt: skip


def stand_in_capture(capture: Path, target: Path, count: int) -> None:
    """``count`` training cameras of a capture of PanopticSports, far from each other, and its held-out ones; of each
    other camera one picture of an instant in the last two thirds as a roving one."""
    source = open_capture(capture, held_out=HELD_OUT)
    rig = source.rig
    chosen = [rig.training[0]]
    while len(chosen) < count:
        away = {
            name: min(float((rig[name].center - rig[own].center).norm()) for own in chosen) for name in rig.training
        }
        chosen.append(max(away, key=lambda name: away[name]))
    cameras, roving = {}, {}
    for number, (name, camera) in enumerate(rig.cameras.items()):
        filmed, files = LensCamera(camera, Pinhole()), sorted((capture / "ims" / name).glob("*.jpg"))
        if name in chosen or name in rig.held_out:
            shutil.copytree(capture / "ims" / name, target / "pictures" / name, dirs_exist_ok=True)
            cameras[name] = PreparedCamera(f"pictures/{name}", filmed, rectilinear(filmed))
        else:
            instant = len(files) // 3 + 7 * number % (len(files) - len(files) // 3)
            (target / "roving").mkdir(parents=True, exist_ok=True)
            shutil.copyfile(files[instant], target / "roving" / f"{name}.jpg")
            roving[f"roving/{name}"] = PreparedCamera(f"roving/{name}.jpg", filmed, rectilinear(filmed))
    near = next(iter(rig.cameras.values())).near
    write_prepared(target, PreparedCapture(cameras, source.fps, near, held_out=rig.held_out, roving=roving))


def basketball(folder: Path, capture: Path, count: int, *, without: bool, seed: int, preset: str) -> dict[str, Any]:
    """Scores of frame 0 at half the size."""
    target = folder / f"basketball-{count}"
    stand_in_capture(capture, target, count)
    return _scores(target, folder / "basketball.sgs", without=without, seed=seed, preset=preset, scale=0.5)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["film", "poses", "psnr", "basketball"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cameras", type=int, nargs="+", default=[8])
    parser.add_argument("--walk", nargs="+", default=["empty"], choices=["none", "empty", "people"])
    parser.add_argument("--without", action="store_true", help="leave the roving pictures out of frame 0")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--capture", type=Path, help="of basketball")
    parser.add_argument("--masks", choices=["moving", "none"], default="moving", help="none: what moves counts, too")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.what == "film":
        film(options.folder, options.cameras)
        return
    if options.masks == "none":
        WithRoving._changed = lambda self, frame: {}  # type: ignore[method-assign]
    for count in options.cameras:
        for walk in options.walk:
            for seed in [0] if options.what == "poses" else options.seeds:
                key = f"{options.what} {count} {walk}"
                if options.what == "poses":
                    found = poses(options.folder, count, walk)
                elif options.what == "basketball":
                    key = f"basketball {count}{' without' if options.without else ''} {options.preset} {seed}"
                    found = basketball(
                        options.folder,
                        options.capture,
                        count,
                        without=options.without,
                        seed=seed,
                        preset=options.preset,
                    )
                else:
                    key += "" if options.masks == "moving" else " unmasked"
                    key += f"{' without' if options.without else ''} {options.preset} {seed}"
                    found = psnr(options.folder, count, walk, without=options.without, seed=seed, preset=options.preset)
                print(key, json.dumps(found), flush=True)
                if options.json is not None:
                    known = json.loads(options.json.read_text()) if options.json.exists() else {}
                    options.json.write_text(json.dumps({**known, key: found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
