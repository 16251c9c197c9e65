# SPDX-License-Identifier: Apache-2.0
"""Videos of cameras whose calibration and clocks are known: a room in which balls fly, a board, sound."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.preparation.calibration.board import Board
from tests.support.captures import write_video
from tests.support.filmed import Film, Plane, board_plane, ring, room, turned
from tests.support.sounds import add_sound
from tests.support.takes import with_balls

FPS = 30.0
FOCAL, SIZE = 290.0, (320, 240)
BOARD = Board(7, 5, 0.12)
Picture = NDArray[np.uint8]


@cache
def still_room(cameras: int = 5) -> tuple[dict[str, LensCamera], dict[str, Picture]]:
    """Cameras around a room, and their pictures of it."""
    rig = centred(ring(cameras, radius=2.6, arc_degrees=60, focal=FOCAL, size=SIZE))
    return rig, {name: Film(one).picture(room(), noise=1, seed=index) for index, (name, one) in enumerate(rig.items())}


def centred(rig: dict[str, LensCamera]) -> dict[str, LensCamera]:
    """With principal points in the middle."""
    for filmed in rig.values():
        filmed.camera.K[0, 2], filmed.camera.K[1, 2] = filmed.camera.width / 2, filmed.camera.height / 2
    return rig


def write_take(folder: Path, *, starts: Sequence[int], frames: int) -> dict[str, LensCamera]:
    """A video a camera of the room with balls; ``starts`` are the frames that each camera begins with."""
    rig, pictures = still_room(len(starts))
    for start, (name, filmed) in zip(starts, rig.items(), strict=True):
        moments = (np.arange(frames) + start) / FPS
        shots = [with_balls(pictures[name], filmed.camera, moment, radius=0.1) for moment in moments]
        write_video(folder / f"{name}.mp4", shots, fps=FPS)
    return rig


def carried_board(instants: int, *, reach: float = 0.3, far: float = 0.3) -> list[Plane]:
    """The board near the middle, tilted at random: up to ``reach`` across, down and up to ``far`` behind it."""
    generator = np.random.default_rng(3)
    planes = []
    for _ in range(instants):
        yaw, pitch, roll = generator.uniform([-40, -35, -25], [40, 35, 25])
        pose = np.eye(4)
        pose[:3, :3] = turned(yaw, axis=1) @ turned(pitch, axis=0) @ turned(roll, axis=2)
        middle = generator.uniform([-reach, -reach, -0.45], [reach, reach, far])
        pose[:3, 3] = middle - pose[:3, :3] @ [*(side / 2 for side in BOARD.size_metres), 0.0]
        planes.append(board_plane(BOARD, pose))
    return planes


def write_board_take(folder: Path, rig: Mapping[str, LensCamera], *, instants: int, period: float) -> None:
    """Videos in which the board is carried through the middle, a picture each ``period`` seconds."""
    planes = carried_board(instants)
    for name, filmed in rig.items():
        film = Film(filmed)
        shots = [film.picture([plane], noise=1.5, seed=index) for index, plane in enumerate(planes)]
        write_video(folder / f"{name}.mp4", shots, instants=[FPS * period * index for index in range(instants)])


def put_sound(video: Path, samples: NDArray[np.float32]) -> None:
    """The video becomes one of the same name for Matroska that has a mono track of ``samples [N]``."""
    loud = samples[None] / np.abs(samples).max()
    add_sound(video, video.with_suffix(".mkv"), 0.9 * loud, codec="pcm_s16le")
    video.unlink()
