# SPDX-License-Identifier: Apache-2.0
"""Films the rigs: ``python -m lab.rigs.film build/rigs [VARIANT ...]``.

Reads the traced pictures of ``build/rigs/light`` and writes, for each variant, ``VARIANT/videos/CAMERA.mp4``,
``VARIANT/truth.json`` and, where they belong to it, ``VARIANT/board/CAMERA.mp4`` and ``VARIANT/calibration.json``.
"""

import argparse
import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from zlib import crc32

import numpy as np
import torch
from numpy.typing import NDArray

from lab.rigs.board import Drawing, Pose, before_an_arc, inside_a_ring
from lab.rigs.containers import write_video
from lab.rigs.filming import FPS, TICKS_PER_FRAME, Filming, walk
from lab.rigs.light import Sensor
from lab.rigs.optics import Refilmed, filmed_camera
from lab.rigs.rig import (
    FISHEYE_STEPS,
    HELD_OUT,
    NEAR_METRES,
    TARGET,
    Traced,
    look_at,
    traced,
    turned,
)  # fmt: skip
from lab.rigs.rig import base as wide_camera
from lab.rigs.sound import SAMPLE_RATE, Room
from lab.rigs.truth import TrueCamera, Truth, write_truth
from lab.rigs.variants import VARIANTS, Variant
from structgstream.data.lenses import LensCamera
from structgstream.preparation.calibration.board import Board

SEED = 14
BOARD_FPS = 5.0  # the board moves slowly
RING_METRES, RING_HEIGHT = 2.0, 1.3
RING_BOARD = Board(square_metres=0.12)  # a board of 0.35 m is 100 pixels wide at 2 m, too few for its markers
GIVEN_DEGREES, GIVEN_METRES = 0.3, 0.008


@dataclass(frozen=True)
class Light:
    """The traced pictures of a folder, and the same refilmed by lenses.

    Cameras of one rig that share a lens share its map, and a step of the scene is resampled once for each lens.
    """

    folder: Path
    views: dict[str, Traced] = field(default_factory=traced)
    _known: dict[tuple[str, int, str], NDArray[np.float32]] = field(default_factory=dict, repr=False)
    _lenses: dict[str, Refilmed] = field(default_factory=dict, repr=False)

    def traced(self, view: str, step: int) -> NDArray[np.float32]:
        """A traced picture, linear ``[H, W, 3]``."""
        number = self.views[view].steps.index(step)
        return np.load(self.folder / f"{view}_{number:02d}.npy").astype(np.float32)

    def filmed(self, view: str, step: int, lens: LensCamera) -> NDArray[np.float32]:
        """The same through a lens."""
        key = f"{lens.camera.K.tolist()} {lens.lens}"
        if (view, step, key) not in self._known:
            refilmed = self._lenses.setdefault(key, Refilmed(self.views[view].camera, lens))
            self._known[view, step, key] = refilmed(self.traced(view, step))
        return self._known[view, step, key]


def ring_poses() -> dict[str, torch.Tensor]:
    """Eight cameras around the upright axis."""
    rng = np.random.default_rng(SEED)
    found = {}
    for number in range(8):
        angle = 2 * np.pi * number / 8 + rng.uniform(-0.05, 0.05)
        eye = np.array([np.cos(angle), np.sin(angle), 0]) * RING_METRES * rng.uniform(0.95, 1.05)
        eye[2] = RING_HEIGHT + (0.35 if number % 2 else -0.15)
        aimed = np.array([0.0, 0.0, RING_HEIGHT]) + rng.uniform(-0.05, 0.05, 3)
        found[f"cam{number:02d}"] = look_at(eye, aimed, roll_degrees=rng.uniform(-3, 3))
    return found


def lens_cameras(variant: Variant, light: Light) -> dict[str, LensCamera]:
    """The true camera of each name."""
    if variant.take == "fisheye":
        return {name: light.views[f"fisheye-{name}"].camera for name in variant.cameras}
    if variant.take == "ring":
        return {name: filmed_camera(wide_camera(pose), variant.cameras[name]) for name, pose in ring_poses().items()}
    return {name: filmed_camera(light.views[f"base-{name}"].camera, own) for name, own in variant.cameras.items()}


@dataclass(frozen=True)
class Shoot:
    """One variant being filmed."""

    name: str
    variant: Variant
    light: Light
    cameras: dict[str, LensCamera]

    def sensor(self, name: str) -> Sensor:
        """A camera's sensor; every variant has other noise."""
        return Sensor(self.variant.cameras[name], seed=crc32(f"{self.name}/{name}".encode()))

    def pictures(self, name: str) -> Iterator[NDArray[np.uint8]]:
        """What is in the file of a camera."""
        filming, sensor = self.variant.cameras[name], self.sensor(name)
        ticks = filming.ticks(self.variant.frames)
        steps = walk(
            1 + max(int(own.ticks(self.variant.frames)[-1]) for own in self.variant.cameras.values()), seed=SEED
        )
        exposed: dict[tuple[str, int], NDArray[np.float32]] = {}
        for number in filming.kept(self.variant.frames):
            view, step = self._view(name, filming, int(number)), int(steps[ticks[number]])
            if (view, step) not in exposed:
                exposed[view, step] = sensor.exposed(self._linear(view, step, name))
            yield sensor.read(exposed[view, step], int(number))

    def _view(self, name: str, filming: Filming, number: int) -> str:
        if self.variant.take == "fisheye":
            return f"fisheye-{name}"
        bumped = filming.bumped_from is not None and number >= filming.bumped_from
        return f"{'bumped' if bumped else 'base'}-{name}"

    def _linear(self, view: str, step: int, name: str) -> NDArray[np.float32]:
        if self.variant.take == "fisheye":  # traced with its lens, at the first steps only
            return self.light.traced(view, FISHEYE_STEPS[min(step, FISHEYE_STEPS[-1]) // TICKS_PER_FRAME])
        return self.light.filmed(view, step, self.cameras[name])

    def sound(self, name: str) -> NDArray[np.float64] | None:
        """What its microphone hears, as long as its pictures last."""
        if not self.variant.claps:
            return None
        filming = self.variant.cameras[name]
        count = int(filming.stamps(self.variant.frames + 1)[-1] * SAMPLE_RATE)
        number = int(name[-2:])
        return Room(self.variant.claps, seed=SEED).heard(
            self.cameras[name].camera.center.numpy(),
            np.arange(count) / SAMPLE_RATE,
            offset=filming.offset_seconds,
            rate=filming.rate,
            gain=0.6 + 0.1 * (number % 5),
            ear=number,
        )

    def board_poses(self, board: Board) -> list[Pose]:
        """Where the board is in each picture of its film."""
        count = self.variant.board_frames
        if self.variant.take == "ring":
            return inside_a_ring(board, count, radius=RING_METRES, height=RING_HEIGHT, seed=SEED)
        towards = np.mean([camera.camera.center.numpy() for camera in self.cameras.values()], 0)
        return before_an_arc(board, count, target=np.array(TARGET), towards=towards, seed=SEED)

    def board_pictures(self, name: str, board: Board) -> Iterator[NDArray[np.uint8]]:
        """The film of the board by one camera."""
        drawing, sensor = Drawing(board, self.cameras[name]), self.sensor(name)
        ring = self.variant.take == "ring"
        behind = _wall(self.cameras[name]) if ring else self._linear(f"base-{name}", 0, name)
        for number, pose in enumerate(self.board_poses(board)):
            yield sensor.read(sensor.exposed(drawing(behind, pose)), 1_000_000 + number)


def _wall(camera: LensCamera) -> NDArray[np.float32]:
    """A plain grey that fades: nothing but the board can be recognised."""
    across, down = np.meshgrid(np.linspace(-1, 1, camera.camera.width), np.linspace(-1, 1, camera.camera.height))
    grey = 0.22 - 0.05 * across**2 - 0.07 * down
    return np.repeat(grey[..., None], 3, -1).astype(np.float32)


def truth_of(name: str, variant: Variant, cameras: dict[str, LensCamera], light: Light, board: Board) -> Truth:
    """What is known of the rig."""

    def camera(own: str, filming: Filming) -> TrueCamera:
        stamps = filming.stamps(variant.frames)
        bumped = filming.bumped_from
        return TrueCamera(
            filmed=cameras[own],
            offset_seconds=filming.offset_seconds,
            rate=filming.rate,
            stops=filming.stops,
            white_balance=filming.white_balance,
            dropped=tuple(float(stamps[number]) for number in filming.dropped),
            ends=None if filming.dies_after is None else float(stamps[filming.dies_after]),
            bumped=None
            if bumped is None
            else (float(stamps[bumped]), light.views[f"bumped-{own}"].camera.camera.viewmat),
        )

    return Truth(
        variant=name,
        what=variant.what,
        fps=FPS,
        near=NEAR_METRES,
        held_out=None if variant.take == "ring" else HELD_OUT,
        cameras={own: camera(own, filming) for own, filming in variant.cameras.items()},
        claps=tuple((clap.seconds, clap.place) for clap in variant.claps),
        board=asdict(board) if variant.board_frames else None,
        given=variant.given,
    )


def given_calibration(truth: Truth) -> dict[str, object]:
    """multical's JSON, as a tool might hand it over; the cameras of ``truth.given`` are turned and moved in it."""
    cameras, poses = {}, {}
    for name, own in truth.cameras.items():
        viewmat = own.filmed.camera.viewmat.numpy().copy()
        if name in (truth.given or ()):
            moved = np.eye(4)
            moved[:3, :3] = turned("y", GIVEN_DEGREES)
            moved[0, 3] = GIVEN_METRES
            viewmat = moved @ viewmat
        K = own.filmed.camera.K.numpy().copy()
        K[:2, 2] -= 0.5  # multical counts from the centre of the first pixel
        lens = asdict(own.filmed.lens)
        dist = [lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
        size = [own.filmed.camera.width, own.filmed.camera.height]
        cameras[name] = {"model": "standard", "image_size": size, "K": K.tolist(), "dist": [dist]}
        poses[name] = {"R": viewmat[:3, :3].tolist(), "T": viewmat[:3, 3].tolist()}
    return {"cameras": cameras, "camera_poses": poses}


def film(name: str, folder: Path, light: Light) -> None:
    """Films one variant."""
    variant = VARIANTS[name]
    board = RING_BOARD if variant.take == "ring" else Board()
    shutil.rmtree(folder, ignore_errors=True)
    shoot = Shoot(name, variant, light, lens_cameras(variant, light))
    truth = truth_of(name, variant, shoot.cameras, light, board)
    if variant.take != "ring":
        (folder / "videos").mkdir(parents=True)
        for camera, filming in variant.cameras.items():
            stamps = filming.stamps(variant.frames)[filming.kept(variant.frames)]
            path = folder / "videos" / f"{camera}.mp4"
            write_video(path, shoot.pictures(camera), stamps.tolist(), fps=FPS, sound=shoot.sound(camera))
    if variant.board_frames:
        (folder / "board").mkdir(parents=True)
        for camera in variant.cameras:
            stamps = (np.arange(variant.board_frames) / BOARD_FPS).tolist()
            write_video(folder / "board" / f"{camera}.mp4", shoot.board_pictures(camera, board), stamps, fps=BOARD_FPS)
    if variant.given is not None:
        (folder / "calibration.json").write_text(json.dumps(given_calibration(truth), indent=1) + "\n")
    write_truth(folder, truth)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with light/, for the variants")
    parser.add_argument("variants", nargs="*", help=f"of {', '.join(VARIANTS)}; all when none is named")
    options = parser.parse_args()
    light = Light(options.folder / "light")
    for name in options.variants or VARIANTS:
        film(name, options.folder / name, light)
        size = sum(path.stat().st_size for path in (options.folder / name).rglob("*.mp4"))
        print(f"{name}: {size / 1e6:.1f} MB", flush=True)


if __name__ == "__main__":
    main()
