# SPDX-License-Identifier: Apache-2.0
"""Videos of cameras whose calibration and clocks are known: a room in which balls fly, a board, sound."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.opus import SAMPLE_RATE
from structgstream.preparation.calibration.board import Board
from tests.support.captures import write_video
from tests.support.filmed import Film, Plane, board_plane, ring, room, turned
from tests.support.takes import balls

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


def with_balls(background: Picture, filmed: LensCamera, seconds: float) -> Picture:
    """The balls of ``takes`` at an instant in front of a picture."""
    drawn, camera = background.copy(), filmed.camera
    points = balls(seconds) @ camera.viewmat.numpy()[:3, :3].T + camera.viewmat.numpy()[:3, 3]
    focal, (x0, y0) = float(camera.K[0, 0]), (float(camera.K[0, 2]), float(camera.K[1, 2]))
    for index in np.argsort(-points[:, 2]):
        x, y, z = points[index]
        at = [round((focal * x / z + x0 - 0.5) * 16), round((focal * y / z + y0 - 0.5) * 16)]
        cv2.circle(drawn, at, round(focal * 0.1 / z * 16), (250, 40 * int(index), 20), -1, cv2.LINE_AA, 4)
    return drawn


def write_take(folder: Path, *, starts: Sequence[int], frames: int) -> dict[str, LensCamera]:
    """A video a camera of the room with balls; ``starts`` are the frames that each camera begins with."""
    rig, pictures = still_room(len(starts))
    for start, (name, filmed) in zip(starts, rig.items(), strict=True):
        moments = (np.arange(frames) + start) / FPS
        write_video(folder / f"{name}.mp4", [with_balls(pictures[name], filmed, moment) for moment in moments], fps=FPS)
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


def add_sound(video: Path, samples: NDArray[np.float32]) -> None:
    """The video with a sound track, in a file of the same name for Matroska."""
    with av.open(str(video)) as source, av.open(str(video.with_suffix(".mkv")), "w") as target:
        pictures = target.add_stream_from_template(source.streams.video[0])
        sound = target.add_stream("pcm_s16le", rate=SAMPLE_RATE)
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = pictures
                target.mux(packet)
        loud = (samples / np.abs(samples).max() * 30_000).astype(np.int16)[None]
        frame = av.AudioFrame.from_ndarray(loud, format="s16", layout="mono")
        frame.sample_rate, frame.pts = SAMPLE_RATE, 0
        target.mux(sound.encode(frame))
        target.mux(sound.encode())
    video.unlink()
