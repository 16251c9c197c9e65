# SPDX-License-Identifier: Apache-2.0
"""Which cameras were bumped between two frames, and which only have something in their pictures that moved.

The pictures of one camera do not distinguish the two. But matches with other cameras do: if a thing moved, they fit the
camera's pose at both instants; if the camera was bumped, they contradict it at one of the two.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.calibration import listed
from structgstream.data.images import opencv
from structgstream.data.matching import (
    KEYPOINT_SIDE,
    epipolar_errors,
    fundamental_matrix,
    mutual_matches,
    sift_features,
)
from structgstream.frames import MultiViewFrame
from structgstream.geometry import Floats
from structgstream.pose_check.check import Finding
from structgstream.pose_check.tracks import AGREE_PIXELS, Evidence, gather, pixel_scale

KEYPOINTS = 1200
RATIO = 0.8
STILL_PIXELS = 1.0  # times pixel_scale
STILL_SHARE = 0.2
MOVED_SHARE = 0.5
MIN_MATCHES = 30
MANY_KEYPOINTS = 4 * MIN_MATCHES  # of a picture whose like must show some of them again
CLEAR = 0.5  # largest ratio of the errors of two explanations at which a match speaks for the better one
MIN_VOTES = 15
Judgement = Literal["bumped", "stood", "unknown"]


@dataclass(frozen=True)
class Movement:
    """How what is seen in a picture moved."""

    pixels: float  # median shift; 0 for a picture that stayed, infinite for one that is gone
    homography: Floats  # ``[3, 3]``, from pixels of the first picture to pixels of the other

    @property
    def stayed(self) -> bool:
        """Whether the picture is where it was."""
        return self.pixels == 0


STAYED = Movement(0.0, np.eye(3))
GONE = Movement(np.inf, np.eye(3))  # hardly anything of the first picture is in the other


def picture_movement(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> Movement | None:
    """How a camera's picture moved between two frames; None where that cannot be measured.

    It moved if hardly a keypoint stayed and most of them follow one homography (a camera that turns on the spot makes
    exactly that). A flat thing that moves in front of a plain background does that too.
    """
    before, after = (sift_features(picture, count=KEYPOINTS, longest_side=KEYPOINT_SIDE) for picture in (one, other))
    rows, columns = mutual_matches(before.descriptors, after.descriptors, ratio=RATIO).T
    if len(rows) < MIN_MATCHES:
        return GONE if len(before.pixels) >= MANY_KEYPOINTS else None
    start, end = before.pixels[rows], after.pixels[columns]
    still = STILL_PIXELS * pixel_scale(one.shape[1])
    distances = np.linalg.norm(end - start, axis=1)
    if (distances < still).mean() > STILL_SHARE:
        return STAYED
    homography, mask = opencv().findHomography(start, end, opencv().RANSAC, 2 * still)
    follows = np.zeros(len(rows), bool) if mask is None else mask.ravel().astype(bool)
    shift = float(np.median(distances[follows])) if follows.any() else 0.0
    if follows.mean() <= MOVED_SHARE or shift <= still:
        return None
    return Movement(shift, np.asarray(homography, np.float64))


def bump_findings(
    first: MultiViewFrame, last: MultiViewFrame, evidence: Evidence, cameras: Mapping[str, Camera]
) -> list[Finding]:
    """Cameras that were bumped between two frames or then show something else, and once those for which that cannot be
    measured; ``first`` is the frame of ``evidence``."""
    names = [name for name in cameras if name in first.images and name in last.images]
    movements = {name: picture_movement(first.images[name], last.images[name]) for name in names}
    moved = {name: movement for name, movement in movements.items() if movement is not None and not movement.stayed}
    stayed = sum(movement is not None and movement.stayed for movement in movements.values())
    background = stayed > len(moved)  # most cameras see what stands still, so the others would see it too
    gone = [name for name, movement in moved.items() if movement is GONE]
    moved = {name: movement for name, movement in moved.items() if movement is not GONE}
    findings, unknown = [], []
    for name in gone if background else ():
        sentence = (
            f"Camera {name!r} shows in frame {last.index} hardly anything of what it shows in frame {first.index}: it "
            "was covered, turned away or out of focus, or its signal was lost; use the frames before, or leave it out."
        )
        findings.append(Finding("warning", sentence, (name,)))
    if not moved:
        return findings
    later = gather(last, {name: cameras[name] for name in names})
    for name, movement in moved.items():
        judged = _judged(name, movement, (evidence, later), cameras)
        if judged == "bumped" or (judged == "unknown" and background):
            sentence = (
                f"Camera {name!r} was bumped between frame {first.index} and frame {last.index}: its picture is "
                f"shifted by {movement.pixels:.1f} pixels; use the frames before, or film again with the camera fixed."
            )
            findings.append(Finding("error", sentence, (name,)))
        elif judged == "unknown":
            unknown.append(name)
    if unknown:
        sentence = (
            f"It cannot be determined whether {listed(unknown)} stood still between frame {first.index} and frame "
            f"{last.index}: nearly all that their pictures show moved, and no other camera confirms it; let something "
            "with texture stand still in the pictures."
        )
        findings.append(Finding("note", sentence, tuple(unknown)))
    return findings


def _judged(
    name: str, movement: Movement, instants: tuple[Evidence, Evidence], cameras: Mapping[str, Camera]
) -> Judgement:
    """The judgement by matches with other cameras at both instants."""
    back = np.asarray(np.linalg.inv(movement.homography), np.float64)
    votes = [
        _votes(name, change, evidence, cameras)
        for evidence, change in zip(instants, (movement.homography, back), strict=True)
    ]
    enough = [(stood, bumped) for stood, bumped in votes if stood + bumped >= MIN_VOTES]
    if any(bumped > stood for stood, bumped in enough):
        return "bumped"
    # At the first instant a camera that was bumped later fits its calibration, too.
    return "stood" if enough and votes[1] in enough else "unknown"


def _votes(name: str, change: Floats, evidence: Evidence, cameras: Mapping[str, Camera]) -> tuple[int, int]:
    """Numbers of matches that fit a camera's pose as they are, and as they would be at the other instant."""
    stood = bumped = 0
    limit = AGREE_PIXELS * pixel_scale(cameras[name].width)
    for pair in evidence.overlapping():
        if name not in pair:
            continue
        pixels = evidence.pixels(pair)
        matrix = fundamental_matrix(cameras[pair[0]], cameras[pair[1]])
        own = pair.index(name)
        elsewhere = tuple(_moved(each, change) if number == own else each for number, each in enumerate(pixels))
        here, there = epipolar_errors(matrix, *pixels), epipolar_errors(matrix, *elsewhere)
        stood += int(((here < limit) & (here < CLEAR * there)).sum())
        bumped += int(((there < limit) & (there < CLEAR * here)).sum())
    return stood, bumped


def _moved(pixels: Floats, homography: NDArray[np.float64]) -> Floats:
    moved = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ homography.T
    return moved[:, :2] / moved[:, 2:]
