# SPDX-License-Identifier: Apache-2.0
"""Tone curves: what makes one camera's colours another's beyond exposure and white balance, undone on reading.

Cameras of different makes, or with "picture profiles", render the same light by different curves. A gain and a bias per
camera, which a scene has, follow such a curve in the middle only.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.arrays import Floats
from structgstream.data.images import opencv
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import SourceWrapper, resized_to
from structgstream.errors import CalibrationError, MissingExtraError
from structgstream.frames import MultiViewFrame

DEGREE = 3
KNOTS = np.concatenate([np.zeros(DEGREE + 1), np.linspace(0, 1, 6)[1:-1], np.ones(DEGREE + 1)])
IDENTITY = np.stack([KNOTS[i + 1 : i + 1 + DEGREE].mean() for i in range(len(KNOTS) - DEGREE - 1)])
"""Controls of the identity ``[8]``: the Greville abscissae. Any ``gain * IDENTITY + bias`` is that gain and bias."""
CHANNELS = 3


@dataclass(frozen=True)
class ToneCurve:
    """A rising curve for each channel: a cubic B-spline over [0, 1] with eight controls.

    A spline whose controls do not fall does not fall either (de Boor, A Practical Guide to Splines, chapter 11), and it
    is linear in its controls, so that it can be estimated by least squares.

    Args:
        controls: of red, green and blue, each :data:`IDENTITY` for no change; sRGB values of 0 to 1. Lists, as JSON has
            them, will do.

    Raises:
        CalibrationError: not three times eight finite numbers, or controls that fall.
    """

    controls: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        try:
            values = np.array(self.controls, dtype=np.float64)
        except (ValueError, TypeError):
            values = np.empty(0)
        expected = (CHANNELS, len(IDENTITY))
        if values.shape != expected or not np.isfinite(values).all() or (np.diff(values, axis=1) < 0).any():
            raise CalibrationError(
                f"A tone curve needs {len(IDENTITY)} finite numbers that do not fall for each of red, green and blue; "
                f"got {self.controls!r:.120}."
            )
        object.__setattr__(self, "controls", tuple(tuple(map(float, own)) for own in self.controls))

    @classmethod
    def identity(cls) -> "ToneCurve":
        """The curve that changes nothing."""
        return cls((tuple(IDENTITY),) * CHANNELS)

    @property
    def is_identity(self) -> bool:
        """Whether pictures are passed through, to the last bit."""
        return bool((self.table == np.arange(256)[:, None]).all())

    def __call__(self, colors: Floats) -> Floats:
        """Colours ``[..., 3]``, 0 to 1, through the curve; not clamped."""
        return np.stack([basis(colors[..., k]) @ np.array(own) for k, own in enumerate(self.controls)], -1)

    @cached_property
    def table(self) -> NDArray[np.uint8]:
        """``[256, 3]``: what each value of a picture becomes; it nowhere falls, whatever rounding does."""
        levels = np.repeat(np.arange(256)[:, None] / 255, CHANNELS, 1)
        values = np.maximum.accumulate(self(levels), axis=0)
        return np.rint(values * 255).clip(0, 255).astype(np.uint8)

    def apply(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture ``[H, W, 3]`` through the curve."""
        return opencv().LUT(picture, self.table[None])


def basis(values: Floats) -> Floats:
    """The splines' values ``[..., 8]`` at ``values [...]``, which are clamped to [0, 1]."""
    try:
        from scipy.interpolate import BSpline
    except ImportError:
        raise MissingExtraError("scipy", "capture") from None
    at = np.clip(np.asarray(values, np.float64), 0, 1)
    return BSpline.design_matrix(at.ravel(), KNOTS, DEGREE).toarray().reshape(*at.shape, len(IDENTITY))


@dataclass(frozen=True)
class Toned(SourceWrapper):
    """The same frames with each picture through its camera's curve; cameras without one are passed through."""

    curves: Mapping[str, ToneCurve]

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for frame in self.source.frames(start):
            images = {
                name: self.curves[name].apply(image) if name in self.curves else image
                for name, image in frame.images.items()
            }
            yield replace(frame, images=images)

    def resized(self, rig: CameraRig) -> "Toned":
        """The same frames at the sizes of ``rig``, resampled before the curves."""
        return replace(self, source=resized_to(self.source, rig))


def toned(source: FrameSource, curves: Mapping[str, ToneCurve]) -> FrameSource:
    """The capture through these curves; the source itself when none changes anything.

    Around a source of lenses it would lift their black borders, so it belongs inside: ``undistort(toned(...), ...)``.

    Raises:
        CalibrationError: a curve is of a camera that the capture lacks.
    """
    if unknown := [name for name in curves if name not in source.rig.cameras]:
        raise CalibrationError(
            f"There is a tone curve of camera {unknown[0]!r}, which {source.name} lacks; its cameras are "
            f"{', '.join(source.rig)}."
        )
    kept = {name: curve for name, curve in curves.items() if not curve.is_identity}
    return Toned(source, kept) if kept else source
