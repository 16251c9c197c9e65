# SPDX-License-Identifier: Apache-2.0
"""Undistortion of pictures on reading, so that all other modules handle pinhole cameras only.

By default the pinhole has the largest field of view that the lens fills, up to :data:`WIDEST_DEGREES`. The resampling
grid of a camera is computed once. In a picture of a wider field of view than the lens fills, pixels that it does not
show are black and masked."""

import math
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import MAX_SKEW_PIXELS, Camera, CameraRig, skew_pixels
from structgstream.data.images import opencv, reduced_mask
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.source import FrameSource, SourceWrapper, WithRig
from structgstream.errors import CalibrationError, ConfigError
from structgstream.frames import MultiViewFrame
from structgstream.geometry import Floats

WIDEST_DEGREES = 110.0
"""Across the longer side. A rectilinear picture is stretched 3 times at the edge of 110 degrees, 15 times of 150."""
BORDER_SAMPLES = 129
SLACK_PIXELS = 0.01  # by which a sampled border may leave the picture


def rectilinear(filmed: LensCamera, *, degrees: float | None = None, size: tuple[int, int] | None = None) -> Camera:
    """The pinhole that pictures of a lens can be resampled for, with square pixels.

    Without distortion and skew the camera itself, unless ``degrees`` or ``size`` is given.

    Args:
        degrees: field of view across the picture's width, around the optical axis; None for the largest that the lens
            fills, up to :data:`WIDEST_DEGREES` across the longer side.
        size: width and height of the pictures, pixels; None for those of the lens.

    Raises:
        ConfigError: a field of view of 175 degrees or more, or a size that is not positive.
        CalibrationError: a lens model that is invertible nowhere in its picture.
    """
    width, height = (filmed.camera.width, filmed.camera.height) if size is None else size
    if min(width, height) < 1:
        raise ConfigError(f"A picture of {width}x{height} pixels cannot be made; give a positive width and height.")
    if degrees is None and isinstance(filmed.lens, Pinhole) and skew_pixels(filmed.camera) <= MAX_SKEW_PIXELS:
        return filmed.camera.resized(width, height)
    if degrees is not None:
        check_field_of_view(degrees)
        focal = width / 2 / math.tan(math.radians(degrees) / 2)
        middle = np.zeros(2)
    else:
        low, high = _filled(filmed)
        middle = (low + high) / 2
        least = max(width, height) / 2 / math.tan(math.radians(WIDEST_DEGREES) / 2)
        # The picture's outermost pixel centres lie on the border of what is filled.
        focal = float(max((np.array([width - 1, height - 1]) / (high - low)).max(), least))
    cx, cy = width / 2 - focal * middle[0], height / 2 - focal * middle[1]
    K = torch.tensor([[focal, 0, cx], [0, focal, cy], [0, 0, 1]], dtype=torch.float64)
    return replace(filmed.camera, K=K, width=width, height=height)


def check_field_of_view(degrees: float) -> None:
    """Check an angle across a plane. Raises ConfigError."""
    if not 0 < degrees < 175:
        raise ConfigError(f"A plane cannot show {degrees:g} degrees; give a field of view of less than 175.")


def shows(filmed: LensCamera, normalised: Floats) -> NDArray[np.bool_]:
    """Which directions ``[..., 2]``, x and y at depth 1, a lens has within its picture's outermost pixel centres."""
    pixels = filmed.to_pixels(normalised)  # NaN there, which lies on no side
    most = np.array([filmed.camera.width, filmed.camera.height]) - 0.5 + SLACK_PIXELS
    return np.all((pixels >= 0.5 - SLACK_PIXELS) & (pixels <= most), axis=-1)


def _filled(filmed: LensCamera) -> tuple[Floats, Floats]:
    """Two corners, normalised, of a rectangle around the axis that the lens fills."""
    width, height = filmed.camera.width, filmed.camera.height
    across, down = np.linspace(0.5, width - 0.5, BORDER_SAMPLES), np.linspace(0.5, height - 0.5, BORDER_SAMPLES)
    bounds = []
    for axis, along, edge in ((0, down, width), (1, across, height)):
        for at, worst in ((0.5, np.nanmax), (edge - 0.5, np.nanmin)):
            pixels = np.stack([np.full_like(along, at), along] if axis == 0 else [along, np.full_like(along, at)], -1)
            seen = filmed.to_normalized(pixels)[:, axis]  # NaN where the lens sees no such thing: no bound
            bounds.append(worst(seen) if np.isfinite(seen).any() else math.copysign(math.inf, at - 1))
    most = min(filmed.lens.reach, math.tan(math.radians(WIDEST_DEGREES) / 2))
    low, high = np.maximum(bounds[0::2], -most), np.minimum(bounds[1::2], most)
    if not ((low < 0).all() and (high > 0).all()):
        raise CalibrationError(
            "The lens does not fill a picture around its axis: principal point or distortion belong to another "
            "picture; expected the calibration of these pictures."
        )
    # Corners may lie beyond the reach of the lens, or outside of its picture, although the sides do not.
    for _ in range(400):
        if shows(filmed, _border(low, high)).all():
            return low, high
        low, high = low * 0.99, high * 0.99
    raise CalibrationError(
        "The lens model folds at its axis, so that nothing can be undistorted; check the order of the coefficients."
    )


def _border(low: Floats, high: Floats) -> Floats:
    along = np.linspace(0, 1, BORDER_SAMPLES)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    return np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])


WORTH_REDUCING = 1.25
SCALE_SAMPLES = 33


@dataclass(frozen=True)
class Level:
    """The part of the pinhole's picture that is sampled from one level of the lens picture's pyramid."""

    part: tuple[slice, slice]  # rows and columns of the pinhole's picture
    maps: tuple[NDArray[np.generic], NDArray[np.generic]]
    """Source positions of its pixels, OpenCV's fixed-point numbers of 1/32 pixel."""
    weights: NDArray[np.float32] | None
    """Blending weight ``[h, w]`` float32 of this level over the finer ones; None for the first (weight 1)."""


@dataclass(frozen=True)
class Undistortion:
    """Resamples pictures of ``filmed`` for the pinhole ``target``, which has the same pose.

    Against aliasing where pictures shrink, the picture is first reduced by area as far as no detail is lost; where a
    pixel of the pinhole is still larger than one of the lens, it is sampled from a pyramid (Williams, Pyramidal
    Parametrics, 1983).
    """

    filmed: LensCamera
    target: Camera

    def __call__(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """``[H, W, 3]`` of the lens to ``[H, W, 3]`` of the pinhole; black where the lens shows nothing."""
        cv2 = opencv()
        result = picture
        for number, level in enumerate(self._levels):
            size = self._size(number)
            if picture.shape[1::-1] != size:
                picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            taken = cv2.remap(picture, *level.maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            if level.weights is None:
                result = taken
            else:
                blended = cv2.blendLinear(result[level.part], taken, 1 - level.weights, level.weights)
                result[level.part] = blended
        if self.shown is not None:
            result[~self.shown] = 0
        return result

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """``[H, W]`` of the lens to ``[H, W]`` of the pinhole: a pixel counts if all that it is sampled from counts."""
        cv2 = opencv()
        result = np.ones((self.target.height, self.target.width), bool)
        for number, level in enumerate(self._levels):
            mask = reduced_mask(mask, self._size(number))
            # Bicubic sampling reads from one pixel before to two behind.
            whole = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1)
            taken = cv2.remap(whole, *level.maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) > 0
            result[level.part] &= taken if level.weights is None else taken | (level.weights <= 0)
        return result

    @cached_property
    def shown(self) -> NDArray[np.bool_] | None:
        """Mask ``[H, W]`` of the pinhole's pixels that the lens shows; None if all."""
        shown = shows(self.filmed, _rays(self.target))
        if not shown.any():
            raise CalibrationError("The lens shows nothing of the requested field of view; give another.")
        return None if shown.all() else shown

    @cached_property
    def _levels(self) -> tuple[Level, ...]:
        """The first covers the whole picture; halved ones those parts where they are needed."""
        pixels = self.filmed.to_pixels(_rays(self.target))
        halvings = _halvings(pixels, self.filmed.camera, self._size(0))
        most = max(math.ceil(float(halvings.max()) - 0.5), 0)
        shares = [np.ones_like(halvings), *(np.clip(halvings - number, 0, 1) for number in range(most))]
        return tuple(self._level(number, pixels, share) for number, share in enumerate(shares))

    def _level(self, number: int, pixels: Floats, share: Floats) -> Level:
        cv2 = opencv()
        rows, columns = np.flatnonzero(share.any(1)), np.flatnonzero(share.any(0))
        part = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
        width, height = self._size(number)
        scale = width / self.filmed.camera.width, height / self.filmed.camera.height
        found = pixels[part] * scale - 0.5  # OpenCV's pixel centres are integers
        # Beyond the lens any place will do: those pixels become black.
        found = np.clip(np.nan_to_num(found, nan=-1.0), -1, (width, height)).astype(np.float32)
        maps = cv2.convertMaps(found[..., 0], found[..., 1], cv2.CV_16SC2)
        return Level(part, maps, share[part].astype(np.float32) if number else None)

    def _size(self, number: int) -> tuple[int, int]:
        """The size of the lens's picture after so many halvings; at first it is reduced as far as nothing is lost."""
        factor = (self._min_scale if self._min_scale >= WORTH_REDUCING else 1.0) * 2**number
        camera = self.filmed.camera
        return max(round(camera.width / factor), 1), max(round(camera.height / factor), 1)

    @cached_property
    def _min_scale(self) -> float:
        """Least pixels of the lens, along any direction, in a pixel of the pinhole."""
        sides = (np.linspace(1, side - 1, SCALE_SAMPLES) for side in (self.target.width, self.target.height))
        pixels = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
        straight = LensCamera(self.target, Pinhole())

        def filmed(moved: Floats) -> Floats:
            return self.filmed.to_pixels(straight.to_normalized(pixels + moved))

        jacobians = np.stack([filmed(axis) - filmed(-axis) for axis in np.eye(2) / 2], -1)
        jacobians = jacobians[np.isfinite(jacobians).all((-1, -2))]
        return float(np.linalg.svd(jacobians, compute_uv=False).min()) if len(jacobians) else 1.0


def _halvings(pixels: Floats, camera: Camera, size: tuple[int, int]) -> Floats:
    """Pyramid level ``[H, W]`` (halvings of a picture of ``size``) with pixels as large as the pinhole's."""
    if min(pixels.shape[:2]) < 2:
        return np.zeros(pixels.shape[:2])
    down, across = (np.asarray(np.gradient(pixels, axis=axis)) for axis in (0, 1))
    area = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    area = np.nan_to_num(area * (size[0] / camera.width) * (size[1] / camera.height), nan=1.0)
    return np.maximum(np.log2(np.maximum(area, 1e-12)) / 2, 0)


def _rays(camera: Camera) -> Floats:
    """Normalised points ``[H, W, 2]`` of a pinhole's pixel centres."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1)
    return LensCamera(camera, Pinhole()).to_normalized(pixels.astype(np.float64))


@dataclass(frozen=True)
class UndistortedSource(WithRig):
    """The frames of ``source``, taken with the lenses of ``filmed``, undistorted to the pinholes of the rig ``other``.

    Pictures of cameras without distortion whose size stays are passed through. Pixels that a lens does not show do not
    count.
    """

    filmed: Mapping[str, LensCamera]
    _masks: dict[str, tuple[NDArray[np.bool_], NDArray[np.bool_]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        plans = self.plans

        def pinhole(name: str, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
            return picture if (plan := plans[name]) is None else plan(picture)

        with ThreadPoolExecutor(min(len(self.rig), os.cpu_count() or 1), "lenses") as pool:
            for frame in self.source.frames(start):
                names = [name for name in self.rig if name in frame.images]
                pictures = pool.map(pinhole, names, [frame.images[name] for name in names])
                images = dict(zip(names, pictures, strict=True))
                masks = {name: mask for name in names if (mask := self._mask(name, frame.masks.get(name))) is not None}
                yield replace(frame, images=images, masks=masks)

    def resized(self, rig: CameraRig) -> "UndistortedSource":
        """The same frames at the sizes of ``rig``, resampled once."""
        return replace(self, other=rig)

    @cached_property
    def plans(self) -> Mapping[str, Undistortion | None]:
        """What resamples the pictures of each camera; None for those that are passed through."""

        def changes(name: str) -> bool:
            filmed = self.filmed[name]
            return not (isinstance(filmed.lens, Pinhole) and torch.equal(filmed.camera.K, self.rig[name].K))

        return {name: Undistortion(self.filmed[name], self.rig[name]) if changes(name) else None for name in self.rig}

    def _mask(self, name: str, given: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        """Which pixels of the pinhole count: those that the lens shows and that no mask of its picture leaves out."""
        plan = self.plans[name]
        if plan is None or given is None:
            return given if plan is None else plan.shown
        known = self._masks.get(name)
        if known is None or known[0] is not given:  # Most masks are one for all frames.
            mask = plan.mask(given)
            known = self._masks[name] = (given, mask if plan.shown is None else mask & plan.shown)
        return known[1]


def lenses_of(source: FrameSource) -> Mapping[str, LensCamera] | None:
    """The cameras with lenses of a capture that is undistorted below some wrappers; None of another."""
    while isinstance(source, SourceWrapper):
        if isinstance(source, UndistortedSource):
            return source.filmed
        source = source.source
    return None


def undistort(
    source: FrameSource, filmed: Mapping[str, LensCamera], *, target: Callable[[LensCamera], Camera] = rectilinear
) -> FrameSource:
    """A capture whose cameras have lenses, as one of pinholes; the source itself when none distorts.

    Args:
        source: its rig has the intrinsics and sizes of ``filmed``.
        target: chooses the pinhole for a camera, see :func:`rectilinear`.

    Raises:
        CalibrationError: a lens that cannot be undistorted, naming its camera.
    """
    cameras: dict[str, Camera] = {}
    for name in source.rig:
        try:
            cameras[name] = replace(target(filmed[name]), near=source.rig[name].near)
        except CalibrationError as error:
            raise CalibrationError(f"Camera {name!r} of {source.name}: {error}") from None
    return undistorted_to(source.rig.mapped(cameras), source, filmed)


def undistorted_to(pinholes: CameraRig, source: FrameSource, filmed: Mapping[str, LensCamera]) -> FrameSource:
    """``source``, taken with lenses, for these pinholes; the source itself if that changes nothing."""
    made = UndistortedSource(source, pinholes, filmed)
    return made if any(made.plans.values()) else source
