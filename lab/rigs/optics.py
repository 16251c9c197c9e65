# SPDX-License-Identifier: Apache-2.0
"""The lenses of the rigs, and their pictures resampled from wider and denser ones."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from lab.rigs.filming import Filming
from structgstream.data.images import opencv
from structgstream.data.lenses import Lens, LensCamera, Pinhole, RadialTangential
from structgstream.geometry import Floats

SIZE = (640, 480)
FOCAL_PIXELS = 600.0
SUBPIXELS = 3

LENSES: dict[str, Lens] = {
    "pinhole": Pinhole(),
    # A good industrial lens.
    "mild": RadialTangential(k1=-0.065, k2=0.012),
    # A phone's main camera: what is left in a video turns over towards the corners, and the lens is off axis.
    "phone": RadialTangential(k1=0.2, k2=-0.8, p1=0.0012, p2=-0.0009, k3=0.8),
}


def filmed_camera(wide: LensCamera, filming: Filming) -> LensCamera:
    """The camera that films, at the place of the one that was traced."""
    width, height = SIZE
    focal = FOCAL_PIXELS * filming.focal_factor
    cx, cy = width / 2 + filming.principal_offset[0], height / 2 + filming.principal_offset[1]
    K = torch.tensor([[focal, 0, cx], [0, focal, cy], [0, 0, 1]], dtype=torch.float64)
    return LensCamera(replace(wide.camera, K=K, width=width, height=height), LENSES[filming.lens])


@dataclass(frozen=True)
class Refilmed:
    """Resamples linear pictures of the pinhole ``wide`` for the lens ``filmed``, which has the same pose.

    Every pixel is the mean of 3x3 points, each interpolated in the wide picture.

    Raises:
        ValueError: the lens sees something that the wide picture does not show.
    """

    wide: LensCamera
    filmed: LensCamera

    def __call__(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """``[H, W, 3]`` float32 of the wide camera to ``[h, w, 3]`` of the lens."""
        cv2 = opencv()
        fine = cv2.remap(picture, *self._maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        height, width = self.filmed.camera.height, self.filmed.camera.width
        means = fine.reshape(height, SUBPIXELS, width, SUBPIXELS, 3).mean((1, 3), dtype=np.float32)
        return np.maximum(means, 0)

    @cached_property
    def _maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        found = self.wide.to_pixels(normalised_subpixels(self.filmed))
        size = np.array([self.wide.camera.width, self.wide.camera.height])
        if not np.all((found >= 0) & (found <= size)):
            raise ValueError("the lens sees more than was traced; give it a longer focal length")
        found = (found - 0.5).astype(np.float32)  # OpenCV's pixel centres are integers
        return np.ascontiguousarray(found[..., 0]), np.ascontiguousarray(found[..., 1])


def normalised_subpixels(camera: LensCamera) -> Floats:
    """Undistorted normalised points ``[3 h, 3 w, 2]`` of the points whose mean a pixel is.

    The lens is inverted at the corners of pixels and interpolated inside, which for a lens as smooth as these is wrong
    by less than a thousandth of a pixel.
    """
    width, height = camera.camera.width, camera.camera.height
    corners = camera.to_normalized(np.stack(np.meshgrid(np.arange(width + 1.0), np.arange(height + 1.0)), -1))
    inside = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS
    return _between(_between(corners, inside, axis=0), inside, axis=1)


def _between(values: Floats, shares: Floats, *, axis: int) -> Floats:
    """Linear interpolation at ``shares`` of every interval along an axis."""
    first = np.moveaxis(values, axis, 0)[:-1, None]
    second = np.moveaxis(values, axis, 0)[1:, None]
    weights = shares.reshape(1, -1, *[1] * (values.ndim - 1))
    mixed = first + weights * (second - first)
    return np.moveaxis(mixed.reshape(-1, *mixed.shape[2:]), 0, axis)
