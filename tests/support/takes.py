# SPDX-License-Identifier: Apache-2.0
"""Made takes of free-running cameras, whose clocks are known: balls that fly through a room, and what microphones
hear there."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.timeline import Clock
from structgstream.frames import MultiViewFrame
from structgstream.geometry import Floats
from structgstream.opus import SAMPLE_RATE
from tests.support.rigs import look_at

WIDTH, HEIGHT = 160, 120
SOUND_HERTZ = 96000


def ring(count: int, *, degrees: float = 90.0) -> dict[str, Camera]:
    """Cameras on an arc of radius 3 around the origin, at two heights."""
    cameras = {}
    for index in range(count):
        angle = np.radians(degrees) * (index / max(count - 1, 1) - 0.5)
        eye = torch.tensor([3 * np.sin(angle), -0.4 - 0.5 * (index % 2), -3 * np.cos(angle)], dtype=torch.float64)
        K = torch.tensor([[150.0, 0, WIDTH / 2], [0, 150.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
        cameras[f"cam{index}"] = Camera(look_at(eye, torch.zeros(3, dtype=torch.float64)), K, WIDTH, HEIGHT)
    return cameras


def lenses(cameras: Mapping[str, Camera]) -> dict[str, LensCamera]:
    return {name: LensCamera(camera, Pinhole()) for name, camera in cameras.items()}


def balls(seconds: float) -> Floats:
    """Positions ``[5, 3]`` of the balls at an instant: sums of oscillations, each ball with its own."""
    generator = np.random.default_rng(5)
    rates = generator.uniform(1.0, 6.0, (3, 5, 3))
    phases = generator.uniform(0, 2 * np.pi, (3, 5, 3))
    return 0.35 * np.sin(rates * seconds + phases).sum(0)


def with_balls(
    background: NDArray[np.uint8], camera: Camera, seconds: float, *, radius: float = 0.12
) -> NDArray[np.uint8]:
    """The balls at an instant in front of a picture ``[H, W, 3]``."""
    drawn = background.copy()
    points = balls(seconds) @ camera.viewmat.numpy()[:3, :3].T + camera.viewmat.numpy()[:3, 3]
    focal, x0, y0 = float(camera.K[0, 0]), float(camera.K[0, 2]), float(camera.K[1, 2])
    for index in np.argsort(-points[:, 2]):
        x, y, z = points[index]
        # Sixteenths of a pixel, so that positions are not rounded; OpenCV's pixel centres are whole numbers.
        at = [round((focal * x / z + x0 - 0.5) * 16), round((focal * y / z + y0 - 0.5) * 16)]
        cv2.circle(drawn, at, round(focal * radius / z * 16), (250, 40 * int(index), 20), -1, cv2.LINE_AA, 4)
    return drawn


def picture(
    camera: Camera, seconds: float, background: NDArray[np.uint8], noise: np.random.Generator
) -> NDArray[np.uint8]:
    """The room at an instant, ``[H, W, 3]``."""
    drawn = with_balls(background, camera, seconds)
    grain = noise.normal(0, 2, drawn.shape)
    return np.clip(drawn + grain, 0, 255).astype(np.uint8)


@dataclass
class MadeStreams:
    """Streams of cameras with known clocks; what a test does not give is absent."""

    own_stamps: Mapping[str, Floats]
    views: Mapping[str, Camera] = field(default_factory=dict)
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    sounds: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    texts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    still: frozenset[str] = frozenset()

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.own_stamps)

    def stamps(self, name: str) -> Floats:
        return self.own_stamps[name]

    def pictures(self, name: str, indices: NDArray[np.intp]) -> Iterator[NDArray[np.uint8]]:
        seed = self.cameras.index(name)
        generator = np.random.default_rng(seed)
        rough = generator.integers(30, 220, (HEIGHT // 8, WIDTH // 8, 3)).astype(np.uint8)
        background = np.asarray(cv2.resize(rough, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8)
        clock = self.clocks.get(name, Clock())
        for index in indices:
            stamp = float(self.own_stamps[name][index])
            instant = 0.0 if name in self.still else clock.offset_seconds + clock.rate * stamp
            yield picture(self.views[name], instant, background, generator)

    def audio(self, name: str) -> NDArray[np.float32] | None:
        return self.sounds.get(name)

    def size(self, name: str) -> tuple[int, int]:
        return WIDTH, HEIGHT

    def metadata(self, name: str) -> Mapping[str, str]:
        return self.texts.get(name, {})


@dataclass(frozen=True)
class MadeSource:
    """A capture of the room at 30 frames a second, some of whose cameras are late by ``late`` seconds; of those in
    ``apart_seconds`` time stamps say so."""

    rig: CameraRig
    late: Mapping[str, float]
    count: int = 40
    fps: float = 30.0
    name: str = "room"
    points: None = None
    still: bool = False
    apart_seconds: Mapping[str, Floats] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.count

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        generator = np.random.default_rng(0)
        plain = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        for index in range(start, self.count):
            instants = {name: 0.0 if self.still else index / self.fps + self.late.get(name, 0.0) for name in self.rig}
            images = {name: picture(self.rig[name], instants[name], plain, generator) for name in self.rig}
            yield MultiViewFrame(index, index / self.fps, images)


def heard(
    clocks: Mapping[str, Clock],
    *,
    seconds: float = 8.0,
    snr_db: float = 15.0,
    echo: float = 0.03,
    delays: Mapping[str, float] | None = None,
    seed: int = 0,
) -> dict[str, NDArray[np.float32]]:
    """What microphones record, by their own clocks, of claps and of noise that swells: with echoes, gains and noise
    of their own.

    ``echo`` is the amplitude of a sample of the reverberation (0.4 s) beside the direct sound's 1.
    """
    from scipy.signal import oaconvolve

    generator = np.random.default_rng(seed)
    start = min(clock.offset_seconds for clock in clocks.values()) - 0.5
    end = max(clock.offset_seconds + clock.rate * seconds for clock in clocks.values()) + 0.5
    times = np.arange(start, end, 1 / SOUND_HERTZ)
    knots = np.arange(start, end + 0.2, 0.15)
    made = 0.3 * np.maximum(np.interp(times, knots, generator.normal(size=len(knots))), 0)
    made = made * generator.normal(size=len(times))
    for clap in generator.uniform(start + 0.5, end - 0.5, max(int(end - start), 2)):
        first = int((clap - start) * SOUND_HERTZ)
        length = min(round(0.02 * SOUND_HERTZ), len(made) - first)
        made[first : first + length] += generator.normal(0, 3, length) * np.exp(-np.arange(length) / 400)
    recorded = {}
    for name, clock in clocks.items():
        tail = echo * generator.normal(size=round(0.4 * SOUND_HERTZ))
        tail *= np.exp(-np.arange(len(tail)) / (0.06 * SOUND_HERTZ))
        tail[: round(0.002 * SOUND_HERTZ)] = 0
        tail[0] = 1
        wave = oaconvolve(made, tail)[: len(made)]
        common = clock.offset_seconds + clock.rate * np.arange(round(seconds * SAMPLE_RATE)) / SAMPLE_RATE
        samples = np.interp(common - (delays or {}).get(name, 0.0), times, wave) * generator.uniform(0.1, 1)
        samples += generator.normal(0, np.std(samples) * 10 ** (-snr_db / 20), len(samples))
        recorded[name] = samples.astype(np.float32)
    return recorded
