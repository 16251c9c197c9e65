# SPDX-License-Identifier: Apache-2.0
"""A furnished room of textured planes in which two people walk, filmed by a ring of still cameras and by a phone.

All poses, lenses and times are known. Planes are drawn exactly, at the price of a lookup (``tests/support/filmed.py``).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.data.video_writer import VideoWriter
from structgstream.geometry import Floats
from tests.support.filmed import Film, Plane, noise_texture, turned
from tests.support.rigs import look_at

SIZE = (480, 360)
RADIUS_METRES, EYE_METRES = 2.5, 1.5  # of the ring, and above the floor
ROOM_METRES, CEILING_METRES = 6.4, 2.9
FLOOR_Y = 1.2  # y points down; the middle of the ring is 1.2 m above the floor
PERSON_METRES = (0.45, 1.7, 0.3)
WALK_RADIUS_METRES, WALK_SECONDS = 0.75, 9.0
FRAMES, FPS = 13, 1.5  # of a take, 8 s
WALK_FRAMES, WALK_FPS = 120, 4.0  # of the phone, 30 s
NOISE_LEVELS = 1.5


@cache
def still_planes() -> tuple[Plane, ...]:
    """Walls, floor, ceiling, and furniture."""
    generator = np.random.default_rng(5)
    half, high = ROOM_METRES / 2, CEILING_METRES
    planes = [
        _plane(wallpaper(10), (-half, FLOOR_Y, -half), turned(90.0, axis=0), (ROOM_METRES, ROOM_METRES)),
        _plane(wallpaper(11), (-half, FLOOR_Y - high, -half), turned(90.0, axis=0), (ROOM_METRES, ROOM_METRES)),
    ]
    for wall in range(4):
        turn = turned(90.0 * wall, axis=1)
        corner = turn @ np.array([-half, FLOOR_Y - high, half])
        planes.append(_plane(wallpaper(20 + wall), corner, turn, (ROOM_METRES, high)))
    for number in range(9):
        angle, radius = 2 * np.pi * number / 9 + generator.uniform(-0.2, 0.2), generator.uniform(1.25, 1.9)
        size = generator.uniform(0.35, 0.7), generator.uniform(0.35, 0.75), generator.uniform(0.35, 0.7)
        middle = radius * np.sin(angle), radius * np.cos(angle)
        planes.extend(box(40 + number, middle, size, degrees=generator.uniform(0, 90)))
    return tuple(planes)


def people(seconds: float) -> list[Plane]:
    """Two people opposite each other on a circle."""
    planes = []
    for number in range(2):
        angle = 2 * np.pi * (seconds / WALK_SECONDS + number / 2)
        middle = WALK_RADIUS_METRES * np.sin(angle), WALK_RADIUS_METRES * np.cos(angle)
        planes.extend(box(70 + number, middle, PERSON_METRES, degrees=np.degrees(angle)))
    return planes


def box(seed: int, middle: tuple[float, float], size: Sequence[float], *, degrees: float) -> list[Plane]:
    """The sides and the top of a box on the floor; ``size`` is width, height and depth."""
    width, height, depth = size
    turn = turned(degrees, axis=1)
    base = np.array([middle[0], FLOOR_Y, middle[1]])
    sides = []
    for side in range(4):
        own = turn @ turned(90.0 * side, axis=1)
        across, away = (width, depth) if side % 2 == 0 else (depth, width)
        corner = base + own @ np.array([-across / 2, -height, -away / 2])
        sides.append(_plane(painted(10 * seed + side), corner, own, (across, height)))
    top = base + turn @ np.array([-width / 2, -height, -depth / 2])
    return [*sides, _plane(painted(10 * seed + 4), top, turn @ turned(90.0, axis=0), (width, depth))]


def _plane(
    texture: NDArray[np.uint8], corner: Sequence[float] | Floats, rotation: Floats, size: tuple[float, float]
) -> Plane:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, corner
    return Plane(texture, pose, size)


@cache
def painted(seed: int, *, size: int = 192) -> NDArray[np.uint8]:
    """A colour of its own, uneven, with shapes on it."""
    generator = np.random.default_rng(seed)
    base = cv2.GaussianBlur(noise_texture(seed, size=size), (0, 0), size / 24).astype(np.float32)
    picture = generator.uniform(50, 200, 3) + 0.8 * (base - base.mean((0, 1)))
    picture = np.ascontiguousarray(picture.clip(0, 255).astype(np.uint8))
    for _ in range(9):
        middle, radius = generator.integers(0, size, 2).tolist(), int(generator.integers(size // 24, size // 8))
        color = generator.integers(20, 235, 3).tolist()
        if generator.random() < 0.5:
            cv2.circle(picture, middle, radius, color, -1, cv2.LINE_AA)
        else:
            corners = np.array(middle) + generator.integers(-2 * radius, 2 * radius + 1, (3, 2))
            cv2.fillPoly(picture, [corners.astype(np.int32)], color, cv2.LINE_AA)
    return picture


@cache
def wallpaper(seed: int) -> NDArray[np.uint8]:
    """A pale wall with pictures on it."""
    generator, size = np.random.default_rng(seed), 1024
    wall = generator.uniform(140, 200, 3) + 0.25 * (noise_texture(seed, size=size).astype(np.float32) - 128)
    wall = cv2.GaussianBlur(wall, (0, 0), 4)
    for number in range(14):
        width, height = generator.integers(80, 220, 2).tolist()
        x, y = int(generator.integers(0, size - width)), int(generator.integers(0, size - height))
        wall[y : y + height, x : x + width] = cv2.resize(painted(seed * 100 + number), (width, height))
    return wall.clip(0, 255).astype(np.uint8)


def rig(count: int, *, between: bool = False) -> dict[str, LensCamera]:
    """``count`` cameras evenly all around, or those half-way between them: alike lenses, aimed a little beside."""
    generator = np.random.default_rng(3)
    found = {}
    for index in range(count):
        angle = 2 * np.pi * (index + 0.5 * between) / count + (0 if between else generator.uniform(-0.05, 0.05))
        eye = np.array(
            [RADIUS_METRES * np.sin(angle), FLOOR_Y - EYE_METRES + 0.2 * (-1) ** index, -RADIUS_METRES * np.cos(angle)]
        )
        aimed = generator.uniform((-0.1, 0.2, -0.1), (0.1, 0.4, 0.1))
        focal = 300.0 * generator.uniform(0.99, 1.01)
        lens = RadialTangential(k1=-0.08, k2=0.01)
        found[f"{'test' if between else 'cam'}{index:02d}"] = _filmed(eye, aimed, focal, lens)
    return found


def phone(frame: int) -> LensCamera:
    """The phone of which frame: once around outside of the people, looking across, up and down as a hand does."""
    share = frame / WALK_FRAMES
    angle, radius = 2 * np.pi * 1.05 * share, 2.2 + 0.35 * np.sin(2 * np.pi * 3 * share)
    height = FLOOR_Y - 1.35 + 0.3 * np.sin(2 * np.pi * 4 * share)
    eye = np.array([radius * np.sin(angle), height, -radius * np.cos(angle)])
    aimed = np.array([0.4 * np.sin(7 * angle), 0.35 + 0.2 * np.cos(5 * angle), 0.4 * np.cos(6 * angle)])
    return _filmed(eye, aimed, 345.0, RadialTangential(k1=0.06, k2=-0.03))


def exposure(frame: int) -> float:
    """Gain of the phone, whose exposure is automatic and brighter than the cameras'."""
    return 1.12 + 0.08 * np.sin(2 * np.pi * 2 * frame / WALK_FRAMES)


def film(folder: Path, counts: Sequence[int]) -> None:
    """Writes ``N/videos/CAMERA/FRAME.png`` and ``N/tests/CAMERA/0000.png`` for each N of ``counts``, and the phone's
    videos, ``empty.mp4`` while nobody is there, and ``people.mp4`` while people walk elsewhere than in frame 0."""
    still = still_planes()
    for count in counts:
        for number, (name, filmed) in enumerate(rig(count).items()):
            for frame in range(FRAMES):
                planes = [*still, *people(frame / FPS)]
                _write(
                    folder / str(count) / "videos" / name / f"{frame:04d}.png", filmed, planes, 1000 * number + frame
                )
        for number, (name, filmed) in enumerate(rig(count, between=True).items()):
            _write(folder / str(count) / "tests" / name / "0000.png", filmed, [*still, *people(0.0)], 77_000 + number)
    for name, busy in (("empty", False), ("people", True)):
        with VideoWriter(folder / f"{name}.mp4", fps=WALK_FPS) as video:
            for frame in range(WALK_FRAMES):
                planes = [*still, *people(20.0 + frame / WALK_FPS)] if busy else still
                video.write(picture(phone(frame), planes, seed=frame, gain=exposure(frame)))


def _write(file: Path, filmed: LensCamera, planes: Sequence[Plane], seed: int) -> None:
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), cv2.cvtColor(picture(filmed, planes, seed=seed), cv2.COLOR_RGB2BGR))


def _filmed(eye: Floats, aimed: Floats, focal: float, lens: RadialTangential) -> LensCamera:
    K = torch.tensor([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1]], dtype=torch.float64)
    return LensCamera(Camera(look_at(torch.from_numpy(eye), torch.from_numpy(aimed)), K, *SIZE, near=0.2), lens)


def picture(filmed: LensCamera, planes: Sequence[Plane], *, seed: int, gain: float = 1.0) -> NDArray[np.uint8]:
    """What a camera sees, ``[H, W, 3]``."""
    brighter = [replace(plane, texture=_exposed(plane.texture, gain)) for plane in planes] if gain != 1 else planes
    return Film(filmed).picture(brighter, noise=NOISE_LEVELS, seed=seed)


def covered(filmed: LensCamera) -> NDArray[np.uint8]:
    """255 where people of frame 0 are in a camera's picture ``[H, W]``, and two pixels around, else 0."""
    camera = Film(filmed)
    empty, busy = (camera.picture(planes).astype(int) for planes in (still_planes(), [*still_planes(), *people(0.0)]))
    found = 255 * (np.abs(busy - empty).max(2) > 4).astype(np.uint8)
    return np.asarray(cv2.dilate(found, np.ones((5, 5), np.uint8)), np.uint8)


def _exposed(texture: NDArray[np.uint8], gain: float) -> NDArray[np.uint8]:
    return (texture.astype(np.float32) * gain).clip(0, 255).round().astype(np.uint8)
