# SPDX-License-Identifier: Apache-2.0
"""Whether one camera's picture stayed where it was between two frames."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.descriptor_matches import mutual_matches
from structgstream.data.images import opencv
from structgstream.data.matching import sift_features

KEYPOINTS = 1200
RATIO = 0.8
STILL_PIXELS = 1.0  # of pictures up to 1000 pixels wide, in proportion above
STILL_SHARE = 0.2
MOVED_SHARE = 0.5
LEAST_MATCHES = 30


@dataclass(frozen=True)
class Movement:
    """How what is seen in a picture moved.

    Args:
        pixels: median shift; 0 for a picture that stayed.
        homography: ``[3, 3]``, from pixels of the first picture to pixels of the other.
    """

    pixels: float
    homography: Floats

    @property
    def stayed(self) -> bool:
        """Whether the picture is where it was."""
        return self.pixels == 0


STAYED = Movement(0.0, np.eye(3))


def picture_movement(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> Movement | None:
    """How a camera's picture moved between two frames; None where that cannot be told.

    It moved if hardly a keypoint stayed and most of them follow one homography (a camera that turns on the spot makes
    exactly that). A flat thing that moves in front of a plain background does that too.

    Raises:
        MissingExtraError: cv2 is not installed.
    """
    before, after = (sift_features(picture, count=KEYPOINTS) for picture in (one, other))
    if min(len(before.pixels), len(after.pixels)) < LEAST_MATCHES:
        return None
    rows, columns = mutual_matches(before.descriptors, after.descriptors, ratio=RATIO).T
    if len(rows) < LEAST_MATCHES:
        return None
    start, end = before.pixels[rows], after.pixels[columns]
    still = STILL_PIXELS * max(one.shape[1] / 1000, 1)
    apart = np.linalg.norm(end - start, axis=1)
    if (apart < still).mean() > STILL_SHARE:
        return STAYED
    homography, mask = opencv().findHomography(start, end, opencv().RANSAC, 2 * still)
    follows = np.zeros(len(rows), bool) if mask is None else mask.ravel().astype(bool)
    shift = float(np.median(apart[follows])) if follows.any() else 0.0
    if follows.mean() <= MOVED_SHARE or shift <= still:
        return None
    return Movement(shift, np.asarray(homography, np.float64))
