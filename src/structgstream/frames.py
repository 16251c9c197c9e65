# SPDX-License-Identifier: Apache-2.0
"""The pictures of one time step of a capture."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.errors import CaptureError

MIN_CAMERAS = 2
"""Training cameras that a frame needs, because a single picture does not determine depth."""
BLANK_LEVELS = 2.0
"""Standard deviation, in levels of 255, below which a picture is blank: a covered lens, a camera that starts."""
MAX_BLANK_SHARE = 0.25
"""Share of frame 0's pictures that may be blank while the others are not; if more are, the scene is dark or plain."""
_EVERY_PIXELS = 8  # Every eighth row and column is sufficient to detect content.


@dataclass(frozen=True)
class MultiViewFrame:
    """The pictures of one time step; a camera without a picture is absent from it.

    Args:
        index: position in the stream, 0 for the first reconstructed frame.
        pts_seconds: presentation time, 0 for the first reconstructed frame.
        images: ``[H, W, 3]`` uint8 sRGB by camera name, in the rig's order; sizes may differ between cameras. Cameras
            without a picture of this frame have no entry. Held-out cameras are included if the source provides them;
            training never reads them.
        masks: ``[H, W]`` bool by camera name, True where the picture counts. All pixels count for a camera without an
            entry.
        captured_unix_seconds: time of capture, Unix time, for live cameras.
        mean_of: average number of pictures whose mean is a training pixel (``data/denoising.py``).
    """

    index: int
    pts_seconds: float
    images: Mapping[str, NDArray[np.uint8]]
    masks: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    captured_unix_seconds: float | None = None
    mean_of: float = 1.0

    def present(self, names: Iterable[str]) -> tuple[str, ...]:
        """The cameras among ``names`` that have a pixel that counts, in their order."""
        return tuple(
            name for name in names if name in self.images and (name not in self.masks or self.masks[name].any())
        )

    def showing(self, names: Iterable[str]) -> tuple[str, ...]:
        """The cameras of :meth:`present` whose picture is not blank; in frame 0 all of them if many are blank.

        In later frames many pictures are blank at the same time if the recorder fails or the light is off.
        """
        present = self.present(names)
        blank = [name for name in present if self._is_blank(name)]
        if self.index == 0 and len(blank) > MAX_BLANK_SHARE * len(present):
            return present
        return tuple(name for name in present if name not in blank)

    def _is_blank(self, name: str) -> bool:
        sample = (slice(None, None, _EVERY_PIXELS), slice(None, None, _EVERY_PIXELS))
        pixels = self.images[name][sample]
        if name in self.masks:
            pixels = pixels[self.masks[name][sample]]
        return pixels.size > 0 and float(pixels.reshape(-1, 3).std(0).max()) < BLANK_LEVELS

    def __repr__(self) -> str:
        shapes = sorted({image.shape for image in self.images.values()})
        return f"MultiViewFrame(index={self.index}, pts_seconds={self.pts_seconds:.4f}, {len(self.images)} x {shapes})"


def check_pictures(frame: MultiViewFrame, rig: CameraRig, *, capture: str) -> None:
    """Check that the training pictures of a frame and their masks are of the type and size that the rig states.

    Raises:
        CaptureError: one is not, or the frame has a camera that the rig does not have.
    """
    if unknown := [name for name in frame.images if name not in rig.cameras]:
        raise CaptureError(
            f"Frame {frame.index} of {capture} has a picture of camera {unknown[0]!r}, which the rig does not have; "
            f"its cameras are {', '.join(rig)}."
        )
    for name in rig.training:
        size = (rig[name].height, rig[name].width)
        for what, arrays, dtype, shape in (
            ("picture", frame.images, np.uint8, (*size, 3)),
            ("mask", frame.masks, np.bool_, size),
        ):
            if name not in arrays:
                continue
            given = np.asarray(arrays[name])
            if not isinstance(arrays[name], np.ndarray) or given.dtype != dtype or given.shape != shape:
                raise CaptureError(
                    f"The {what} of camera {name!r} in frame {frame.index} of {capture} is a "
                    f"{type(arrays[name]).__name__} of {given.dtype} {[*given.shape]}; expected a numpy array of "
                    f"{np.dtype(dtype)} {[*shape]}{', red first' if what == 'picture' else ''}."
                )


@dataclass(frozen=True)
class RovingPicture:
    """A picture by a camera that was carried through the set, which trains frame 0 alone (``data/roving.py``).

    Args:
        camera: its pose, in the units of the rig.
        image: ``[H, W, 3]`` uint8 sRGB.
        mask: ``[H, W]`` bool, False where frame 0 has what moves; such pixels do not count.
    """

    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
