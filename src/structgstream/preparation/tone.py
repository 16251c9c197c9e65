# SPDX-License-Identifier: Apache-2.0
"""Tone curves from the colours that several cameras have of the same points of the scene.

What is solved for stands in ``tone_fit.py``, Note [Common tone]. Held-out cameras do not take part: their curves are
fitted to the colours of the others afterwards.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.images import opencv
from structgstream.data.tone import CHANNELS, IDENTITY, ToneCurve, basis
from structgstream.errors import CaptureError
from structgstream.preparation.tone_fit import common_curves, curve_towards, gain_and_bias, slopes

Indices = NDArray[np.int64]

DARKEST, BRIGHTEST = 3, 252
"""Of 255; a window with a value beyond may be clipped."""
WINDOW_SHARE = 1 / 200
"""Half width of the averaged window over the picture's width: colours at keypoints change within pixels."""
KEPT_OUT = 5
"""Every fifth point is kept from the estimation, to measure it."""
LEAST_SAMPLES = 60
"""Of a camera, for each channel. Fewer do not tell a curve from noise."""


class Tracks(Protocol):
    """Points of the scene in pictures, arrays ``[M]``: which point and camera, where ``[M, 2]``, at which instant."""

    @property
    def point(self) -> Indices: ...
    @property
    def camera(self) -> Indices: ...
    @property
    def pixels(self) -> Floats: ...
    @property
    def instant(self) -> Indices: ...


@dataclass(frozen=True)
class ColorSamples:
    """Colours of points: ``point [M]``, ``camera [M]``, ``colors [M, 3]`` (0 to 1), ``usable [M, 3]`` (not clipped)."""

    point: Indices
    camera: Indices
    colors: Floats
    usable: NDArray[np.bool_]


@dataclass(frozen=True)
class ToneErrors:
    """Mean difference of colours from their point's median over cameras, of 255, on points kept out of the estimation.

    Args:
        as_filmed: of the pictures as they are.
        with_gains: after the best gain and bias for each camera and channel, which a scene has anyway.
        with_curves: after the curves.
    """

    as_filmed: float
    with_gains: float
    with_curves: float


@dataclass(frozen=True)
class ToneEstimate:
    """Curves of cameras, and how well colours agree; cameras with too few points have neither."""

    curves: Mapping[str, ToneCurve]
    errors: ToneErrors
    errors_of: Mapping[str, ToneErrors]


def sample_colors(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]], tracks: Tracks, *, cameras: Sequence[str]
) -> ColorSamples:
    """The mean colours around the pixels of ``tracks``.

    Args:
        pictures: of each camera, by instant.
        tracks: pixels with the top-left pixel's centre at (0.5, 0.5).
        cameras: names in the order that ``tracks.camera`` counts.
    """
    cv2 = opencv()
    colors = np.zeros((len(tracks.point), CHANNELS))
    usable = np.zeros((len(tracks.point), CHANNELS), bool)
    for number, name in enumerate(cameras):
        for instant, picture in enumerate(pictures.get(name, ())):
            rows = np.flatnonzero((tracks.camera == number) & (tracks.instant == instant))
            if not len(rows):
                continue
            height, width = picture.shape[:2]
            half = max(round(width * WINDOW_SHARE), 1)
            window = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
            x, y = np.floor(tracks.pixels[rows]).astype(int).T
            inside = (x >= half) & (y >= half) & (x < width - half) & (y < height - half)
            x, y = x.clip(0, width - 1), y.clip(0, height - 1)
            mean = cv2.blur(picture.astype(np.float32), window.shape)
            clipped = (cv2.erode(picture, window) < DARKEST) | (cv2.dilate(picture, window) > BRIGHTEST)
            colors[rows] = mean[y, x] / 255
            usable[rows] = inside[:, None] & ~clipped[y, x]
    return ColorSamples(np.asarray(tracks.point), np.asarray(tracks.camera), colors, usable)


def estimate_tones(
    samples: ColorSamples, *, cameras: Sequence[str], held_out: Collection[str] = (), seed: int = 0
) -> ToneEstimate:
    """The curves towards a common tone.

    Args:
        samples: colours of the points.
        cameras: names in the order that ``samples.camera`` counts.
        held_out: cameras that the curves of others must not depend on.
        seed: chooses the points that are kept out.

    Raises:
        CaptureError: fewer than two cameras have enough points in common.
    """
    held = frozenset(cameras.index(name) for name in held_out)
    channels = [_channel(samples, k, held=held, cameras=cameras, seed=seed) for k in range(CHANNELS)]
    solved = [number for number in range(len(cameras)) if all(number in channel.cameras for channel in channels)]
    straight, curved = (
        np.stack([_controls(channel, len(cameras), free=free) for channel in channels], 1)
        for free in (gain_and_bias(), slopes())
    )
    as_filmed = np.broadcast_to(IDENTITY, curved.shape)
    spreads = np.stack(
        [
            np.mean([_spread(channel, controls[:, k]) for k, channel in enumerate(channels)], 0)
            for controls in (as_filmed, straight, curved)
        ],
        1,
    )
    return ToneEstimate(
        {cameras[number]: ToneCurve(tuple(map(tuple, curved[number].tolist()))) for number in solved},
        ToneErrors(*map(float, np.nanmean(spreads[solved], 0))),
        {cameras[number]: ToneErrors(*map(float, spreads[number])) for number in solved},
    )


class _Channel(NamedTuple):
    """One channel of the samples that can be used.

    ``point [M]``, ``camera [M]``, ``values [M]``; ``fitted [M]``, else kept out; ``held``, cameras that come last;
    ``cameras``, those with enough samples.
    """

    point: Indices
    camera: Indices
    values: Floats
    fitted: NDArray[np.bool_]
    held: frozenset[int]
    cameras: tuple[int, ...]


def _channel(
    samples: ColorSamples, channel: int, *, held: frozenset[int], cameras: Sequence[str], seed: int
) -> _Channel:
    """The samples, not clipped, of points that two cameras or more see; held-out ones do not count for that."""
    usable: NDArray[np.bool_] = samples.usable[:, channel]
    training = usable & ~np.isin(samples.camera, list(held))
    points = int(samples.point.max(initial=-1)) + 1
    seen = np.bincount(samples.point[training], minlength=points)
    kept_out = np.random.default_rng(seed).permutation(points) % KEPT_OUT == 0
    fitted = usable & (seen[samples.point] >= 2) & ~kept_out[samples.point]
    counts = np.bincount(samples.camera[fitted], minlength=len(cameras))
    enough = counts >= LEAST_SAMPLES
    if enough[[number not in held for number in range(len(cameras))]].sum() < 2:
        raise CaptureError(
            f"Tone curves need {LEAST_SAMPLES} points, not clipped, that a camera shares with another, of two cameras; "
            f"{', '.join(f'{name} has {n}' for name, n in zip(cameras, counts))}. Film with more overlap and less "
            "glare, or prepare without tone curves."
        )
    rows = usable & (seen[samples.point] >= 2) & enough[samples.camera]
    _, point = np.unique(samples.point[rows], return_inverse=True)
    numbers = tuple(np.flatnonzero(enough).tolist())
    return _Channel(point, samples.camera[rows], samples.colors[rows, channel], fitted[rows], held, numbers)


def _controls(channel: _Channel, count: int, *, free: Floats) -> Floats:
    """The controls ``[C, 8]`` of all cameras, the identity's where there are not enough samples."""
    controls = np.tile(IDENTITY, (count, 1))
    joint = np.array([number for number in channel.cameras if number not in channel.held])
    own = channel.fitted & np.isin(channel.camera, joint)
    _, point = np.unique(channel.point[own], return_inverse=True)
    camera = np.searchsorted(joint, channel.camera[own])
    controls[joint] = common_curves(point, camera, channel.values[own], free=free)
    common = np.full(int(channel.point.max()) + 1, np.nan)
    mapped = _mapped(channel.values[own], controls[channel.camera[own]])
    common[channel.point[own]] = _medians(point, mapped)
    for number in sorted(channel.held.intersection(channel.cameras)):
        rows = channel.fitted & (channel.camera == number) & np.isfinite(common[channel.point])
        controls[number] = curve_towards(channel.values[rows], common[channel.point[rows]], free=free)
    return controls


def _spread(channel: _Channel, controls: Floats) -> Floats:
    """Mean distance ``[C]`` from the points' medians over cameras, of 255, on the points that were kept out."""
    rows = ~channel.fitted
    camera = channel.camera[rows]
    mapped = _mapped(channel.values[rows], controls[camera])
    off = np.abs(mapped - _medians(channel.point[rows], mapped)) * 255
    counts, sums = (np.bincount(camera, weights, minlength=len(controls)) for weights in (None, off))
    return np.divide(sums, counts, out=np.full(len(controls), np.nan), where=counts > 0)


def _mapped(values: Floats, controls: Floats) -> Floats:
    """``values [M]`` through the curves ``controls [M, 8]``."""
    return (basis(values) * controls).sum(1)


def _medians(point: Indices, values: Floats) -> Floats:
    """For each sample ``[M]``, the median of ``values [M]`` over the samples of its point."""
    order = np.lexsort((values, point))
    _, starts, inverse, counts = np.unique(point[order], return_index=True, return_inverse=True, return_counts=True)
    ranked = values[order]
    medians = (ranked[starts + (counts - 1) // 2] + ranked[starts + counts // 2]) / 2
    result = np.empty_like(values)
    result[order] = medians[inverse]
    return result
