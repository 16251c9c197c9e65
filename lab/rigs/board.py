# SPDX-License-Identifier: Apache-2.0
"""A ChArUco board moved before the cameras, drawn into their pictures by its plane: no path tracing is needed."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lab.rigs.optics import SUBPIXELS, normalised_subpixels
from lab.rigs.rig import turned
from structgstream.data.images import opencv
from structgstream.data.lenses import LensCamera
from structgstream.geometry import Floats
from structgstream.preparation.calibration.board import Board

PAPER, INK = 0.82, 0.035  # reflectances
MARGIN_SQUARES = 0.5
PIXELS_A_SQUARE = 66


def reflectance(board: Board) -> NDArray[np.float32]:
    """The print ``[h, w]``, :data:`PIXELS_A_SQUARE` to a square; its margin of :data:`MARGIN_SQUARES` is paper."""
    size = board.columns * PIXELS_A_SQUARE, board.rows * PIXELS_A_SQUARE
    drawn = board.opencv_board().generateImage(size, marginSize=0).astype(np.float32) / 255
    margin = round(MARGIN_SQUARES * PIXELS_A_SQUARE)
    return np.pad(INK + (PAPER - INK) * drawn, margin, constant_values=PAPER).astype(np.float32)


def middle(board: Board) -> Floats:
    """The middle of the board in its own axes, metres."""
    return np.array([*board.size_metres, 0]) / 2


@dataclass(frozen=True)
class Pose:
    """Where the board is: ``point = rotation @ own + translation``; its face looks along minus its z axis."""

    rotation: Floats
    translation: Floats


def placed(board: Board, place: Floats, towards: Floats, *, tilt: tuple[float, float, float]) -> Pose:
    """The board with its middle there, its face towards a point, then tilted about its own axes (degrees)."""
    forward = (place - towards) / np.linalg.norm(place - towards)  # the board's z goes away from who looks at it
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    for axis, degrees in zip("xyz", tilt, strict=True):
        rotation = rotation @ turned(axis, degrees)
    return Pose(rotation, place - rotation @ middle(board))


def before_an_arc(board: Board, count: int, *, target: Floats, towards: Floats, seed: int) -> list[Pose]:
    """A smooth path of the board before cameras that stand on one side: all over what they see, tilted every way."""
    t = np.linspace(0, 1, count)
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * math.pi, 6)

    def wave(times: float, phase: float) -> Floats:
        return np.sin(2 * math.pi * times * t + phase)

    middles = np.array(target) + np.stack(
        [0.3 * wave(3.2, phases[0]), -0.35 + 0.2 * wave(1.7, phases[1]), 0.1 + 0.16 * wave(2.3, phases[2])], -1
    )
    tilts = np.stack([28 * wave(2.1, phases[3]), 28 * wave(2.9, phases[4]), 40 * wave(0.8, phases[5])], -1)
    return [placed(board, m, towards, tilt=tuple(a)) for m, a in zip(middles, tilts, strict=True)]


def inside_a_ring(board: Board, count: int, *, radius: float, height: float, seed: int) -> list[Pose]:
    """A path of the board in the middle of a ring of cameras, turned twice about the upright."""
    t = np.linspace(0, 1, count, endpoint=False)
    phases = np.random.default_rng(seed).uniform(0, 2 * math.pi, 5)

    def wave(times: float, phase: float) -> Floats:
        return np.sin(2 * math.pi * times * t + phase)

    facing = 4 * math.pi * t
    middles = np.stack([0.25 * wave(3, phases[0]), 0.25 * wave(5, phases[1]), height + 0.2 * wave(7, phases[2])], -1)
    towards = radius * np.stack([np.cos(facing), np.sin(facing), np.full_like(t, height / radius)], -1)
    tilts = np.stack([22 * wave(9, phases[3]), 0 * t, 30 * wave(4, phases[4])], -1)
    return [placed(board, m, w, tilt=tuple(a)) for m, w, a in zip(middles, towards, tilts, strict=True)]


@dataclass(frozen=True)
class Drawing:
    """Draws the board into linear pictures of a camera.

    Args:
        board: what is drawn.
        camera: whose pictures.
        lamp: place of the light, metres; the board is brighter the more it faces it.
    """

    board: Board
    camera: LensCamera
    lamp: tuple[float, float, float] = (0.25, -0.6, 2.1)

    def __call__(self, behind: NDArray[np.float32], pose: Pose) -> NDArray[np.float32]:
        """``[H, W, 3]`` with the board before it; a pixel is the mean of 3x3 points."""
        part = self._part(pose)
        if part is None:
            return behind
        found, covered = self._on_board(pose, part)
        drawn = opencv().remap(
            self._picture,
            found[..., 0],
            found[..., 1],
            opencv().INTER_LINEAR,
            borderMode=opencv().BORDER_REPLICATE,
        )
        share, ink = _means(covered)[..., None], _means(np.where(covered, drawn, 0))[..., None]
        out = behind.copy()
        out[part] = behind[part] * (1 - share) + ink * np.asarray(self._shade(pose), np.float32)
        return out

    def _on_board(self, pose: Pose, part: tuple[slice, slice]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Places on the board's picture ``[3 h, 3 w, 2]`` of the points of a part's pixels, and which lie on it."""
        fine = tuple(slice(SUBPIXELS * along.start, SUBPIXELS * along.stop) for along in part)
        rays, eye = self._rays[fine], self.camera.camera.center.numpy()
        along = rays @ pose.rotation[:, 2]
        distance = ((pose.translation - eye) @ pose.rotation[:, 2]) / np.where(along > 1e-6, along, np.nan)
        hit = (eye + distance[..., None] * rays - pose.translation) @ pose.rotation[:, :2]
        found = hit / self.board.square_metres * PIXELS_A_SQUARE + MARGIN_SQUARES * PIXELS_A_SQUARE - 0.5
        edge = np.array(self._picture.shape[::-1]) - 0.5
        covered = ((found > -0.5) & (found < edge)).all(-1) & (distance > 0)
        return np.clip(np.nan_to_num(found, nan=-1e4), -1e4, 1e4).astype(np.float32), covered

    def _part(self, pose: Pose) -> tuple[slice, slice] | None:
        """Rows and columns of the picture that the board may cover; None if it is out of it or shows its back."""
        eye = self.camera.camera.center.numpy()
        if (pose.translation - eye) @ pose.rotation[:, 2] <= 0:
            return None
        margin = MARGIN_SQUARES * self.board.square_metres
        low, high = np.full(2, -margin), 2 * middle(self.board)[:2] + margin
        share = np.linspace(0, 1, 24)[:, None]
        corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        outline = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
        pixels = self.camera.pixels(np.pad(outline, ((0, 0), (0, 1))) @ pose.rotation.T + pose.translation)
        if np.isnan(pixels).all():
            return None
        most = np.array([self.camera.camera.width, self.camera.camera.height])
        first = np.clip(np.floor(np.nanmin(pixels, 0)) - 3, 0, most).astype(int)
        last = np.clip(np.ceil(np.nanmax(pixels, 0)) + 3, 0, most).astype(int)
        if (first >= last).any():
            return None
        return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))

    def _shade(self, pose: Pose) -> tuple[float, float, float]:
        """Warm light from above, and dim light from everywhere."""
        to_lamp = np.array(self.lamp) - pose.translation
        cosine = float(np.clip(-pose.rotation[:, 2] @ to_lamp / np.linalg.norm(to_lamp), 0, 1))
        light = 0.45 + 0.45 * cosine
        return (light, 0.97 * light, 0.92 * light)

    @cached_property
    def _picture(self) -> NDArray[np.float32]:
        return reflectance(self.board)

    @cached_property
    def _rays(self) -> Floats:
        """World directions ``[3 H, 3 W, 3]``, one unit deep."""
        normalised = normalised_subpixels(self.camera)
        local = np.concatenate([normalised, np.ones_like(normalised[..., :1])], -1)
        return local @ self.camera.camera.viewmat[:3, :3].numpy()


def _means(values: NDArray[np.generic]) -> NDArray[np.float32]:
    height, width = values.shape[0] // SUBPIXELS, values.shape[1] // SUBPIXELS
    return values.reshape(height, SUBPIXELS, width, SUBPIXELS).mean((1, 3), dtype=np.float32)
