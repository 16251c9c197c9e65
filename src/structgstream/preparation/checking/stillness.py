# SPDX-License-Identifier: Apache-2.0
"""Whether cameras stood still: what does not move lies in the same place of a camera's first and last picture."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from structgstream.data.descriptor_matches import mutual_matches
from structgstream.data.matching import load_cv2, sift_features
from structgstream.preparation.checking.findings import Finding

KEYPOINTS = 1200
RATIO = 0.8
STILL_PIXELS = 1.0  # of pictures up to 1000 pixels wide, in proportion above
STILL_SHARE = 0.2
MOVED_SHARE = 0.5
LEAST_MATCHES = 30


def stillness_findings(
    first: Mapping[str, NDArray[np.uint8]], last: Mapping[str, NDArray[np.uint8]], *, frames: tuple[int, int]
) -> list[Finding]:
    """Cameras that were bumped between two frames.

    Args:
        first: name of a camera to its picture ``[H, W, 3]`` of the first one.
        last: the same of the other one.
        frames: their numbers.

    Raises:
        MissingExtraError: cv2 is not installed.
    """
    findings = []
    for name in first:
        if name in last and (shift := picture_shift(first[name], last[name])) is not None:
            findings.append(
                Finding(
                    "error",
                    f"Camera {name!r} was bumped between frame {frames[0]} and frame {frames[1]}: its picture is "
                    f"shifted by {shift:.1f} pixels; use the frames before, or film again with the camera fixed.",
                    (name,),
                )
            )
    return findings


def picture_shift(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float | None:
    """Median shift in pixels between two pictures of one camera if the camera moved; None if it stood still.

    It moved if hardly a keypoint stayed and most of them follow one homography (a camera that turns on the spot makes
    exactly that).
    """
    cv2 = load_cv2()
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
        return None
    _, mask = cv2.findHomography(start, end, cv2.RANSAC, 2 * still)
    follows = np.zeros(len(rows), bool) if mask is None else mask.ravel().astype(bool)
    shift = float(np.median(apart[follows])) if follows.any() else 0.0
    return shift if follows.mean() > MOVED_SHARE and shift > still else None
