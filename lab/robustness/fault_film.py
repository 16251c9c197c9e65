# SPDX-License-Identifier: Apache-2.0
"""Cameras that film a block that moves, and go wrong at moments that a seed gives.

``python -m lab.robustness.fault_film FOLDER`` reads ``FOLDER/film.json`` (:class:`Film`), writes ``FOLDER/rig.toml``,
prints the Unix time at which picture 0 is filmed, and sends until it is ended.
"""

import argparse
import json
import random
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.world import wall_rig
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.prepared import PreparedCamera, PreparedCapture, write_prepared
from tests.support.sender_modules import sender

WIDTH, HEIGHT, PICTURES = 128, 96, 12
BEGIN_SECONDS, PERIOD_SECONDS = 6.0, 8.0
LENGTHS_SECONDS = (1.0, 2.4)
LOOPED = ("stuck", "size", "shape")  # another video, which begins with its next key frame or the one after
LOOPED_SECONDS = (2.6, 3.6)
SPREAD_SECONDS = 1.5
RIG_SETTINGS = {"deadline_seconds": 0.3, "silent_seconds": 1.0, "stuck_seconds": 0.5, "queue_frames": 64}


@dataclass(frozen=True)
class Moment:
    """A camera goes wrong for a while; seconds of the film."""

    camera: str
    fault: str
    start: float
    length: float


@dataclass(frozen=True)
class Film:
    """What is sent.

    Args:
        cameras: their names.
        moments: when they go wrong, rising for each camera.
        fps: pictures a second.
        transport: of ``tests/support/senders/send.py``.
        clock: of the rig file.
    """

    cameras: tuple[str, ...]
    moments: tuple[Moment, ...]
    fps: float = 10.0
    transport: str = "http"
    clock: str = "unix"

    @property
    def seconds(self) -> float:
        """Until the last moment is over for a period."""
        return max((one.start + one.length for one in self.moments), default=0.0) + PERIOD_SECONDS

    def span(self, moment: Moment) -> tuple[float, float]:
        """When the first wrong picture and the first right one after it are filmed, seconds of the film."""
        first, last = (int(np.ceil(at * self.fps - 1e-9)) for at in (moment.start, moment.start + moment.length))
        return first / self.fps, last / self.fps


def film_of(fault: str, *, moments: int, seed: int, **settings: Any) -> Film:
    """A film in which each camera goes wrong about once in :data:`PERIOD_SECONDS`, in turns."""
    lengths = LOOPED_SECONDS if fault in LOOPED else LENGTHS_SECONDS
    cameras, rng = tuple(wall_rig(11, width=WIDTH, height=HEIGHT).cameras), random.Random(f"{fault} {seed}")
    found = []
    for number in range(moments):
        turn, index = divmod(number, len(cameras))
        start = BEGIN_SECONDS + PERIOD_SECONDS * (turn + index / len(cameras)) + rng.uniform(0, SPREAD_SECONDS)
        found.append(Moment(cameras[index], fault, start, rng.uniform(*lengths)))
    return Film(cameras, tuple(found), **settings)


def pictures() -> NDArray[np.uint8]:
    """The pictures ``[12, H, W, 3]`` that are filmed again and again: each can be told from the others."""
    down, across = np.mgrid[:HEIGHT, :WIDTH]
    ground = (40 + 60 * np.sin(across / 20) + 40 * np.cos(down / 15)).clip(0, 255).astype(np.uint8)
    found = np.repeat(np.repeat(ground[None, ..., None], 3, 3), PICTURES, 0)
    for number in range(PICTURES):
        left = 4 + number * (WIDTH - 28) // PICTURES
        found[number, 20:44, left : left + 20] = (230, 40 + 10 * number, 30)
    return found


def write_film(folder: Path, film: Film) -> None:
    """The film and the calibration of its cameras."""
    rig = wall_rig(11, width=WIDTH, height=HEIGHT)
    cameras = {
        name: PreparedCamera(f"{name}.mp4", LensCamera(own, Pinhole()), own) for name, own in rig.cameras.items()
    }
    folder.mkdir()
    write_prepared(folder, PreparedCapture(cameras, film.fps, 0.1, held_out=rig.held_out))
    (folder / "film.json").write_text(json.dumps(asdict(film)))


def read_film(folder: Path) -> Film:
    """What :func:`write_film` wrote."""
    content = json.loads((folder / "film.json").read_text())
    moments = tuple(Moment(**one) for one in content.pop("moments"))
    return Film(**{**content, "cameras": tuple(content["cameras"]), "moments": moments})


def send(folder: Path) -> None:
    """Sends the film of a folder until the process is ended."""
    module, film = sender(), read_film(folder)
    loops = module.loops_of([*pictures()])
    lines, urls = module.opened_lines(film.transport, film.cameras)
    troubles = {name: _troubles(module, film.moments, name) for name in film.cameras}
    cameras = [
        module.SentCamera(name, loops, lines[name], film.fps, troubles[name], seed)
        for seed, name in enumerate(film.cameras)
    ]
    settings = {"clock": film.clock, "fps": film.fps, **RIG_SETTINGS}
    (folder / "rig.toml").write_text(module.rig_text(urls, folder, **settings))
    print(time.time(), flush=True)
    module.film(cameras, threading.Event())


def _troubles(module: Any, moments: Sequence[Moment], camera: str) -> list[Any]:
    return [module.Trouble(camera, module.Fault(m.fault), m.start, m.length) for m in moments if m.camera == camera]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    send(parser.parse_args().folder)
