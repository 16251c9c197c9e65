# SPDX-License-Identifier: Apache-2.0
"""Random seeds of frames, checks of a frame's pictures, and initial points of frame 0."""

import torch

from structgstream.cameras import CameraRig
from structgstream.data.points import PointsConfig, initial_points
from structgstream.data.source import FrameStream
from structgstream.errors import CaptureError
from structgstream.frames import MIN_CAMERAS, MultiViewFrame
from structgstream.similarity import Similarity


def frame_seed(seed: int, index: int) -> int:
    """The seed of a frame, which depends only on its index, so that a frame can be repeated separately."""
    return (seed * 1_000_003 + index) % 2**63


def shows_enough(frame: MultiViewFrame, rig: CameraRig) -> bool:
    """Whether a later frame can be fitted: at least two training cameras have pictures that are not blank."""
    return len(frame.showing(rig.training)) >= MIN_CAMERAS


def check_enough_pictures(frame: MultiViewFrame, rig: CameraRig, capture: str) -> None:
    """Check that at least two training cameras have pictures, which in frame 0 must not be blank.

    Raises:
        CaptureError: they do not; the message names the cameras.
    """
    present = frame.present(rig.training) if frame.index else frame.showing(rig.training)
    if len(present) < MIN_CAMERAS:
        raise CaptureError(
            f"Frame {frame.index} of {capture} has pictures of {', '.join(present) or 'none'} of its "
            f"{len(rig.training)} training cameras; at least {MIN_CAMERAS} are needed. Restore them, or choose "
            "frames before or after it (--start, --frames)."
        )


def initial_points_of(
    source: FrameStream, frame: MultiViewFrame, *, config: PointsConfig, seed: int, similarity: Similarity
) -> torch.Tensor:
    """Normalised points ``[P, 3]`` of the capture, or estimated from ``frame``, after checking the poses.

    A capture's points are those of its first frame; at the beginning of later periods they are estimated.
    """
    from structgstream.pose_check.check import check_poses

    check_poses(frame, source.rig)
    given = source.points if frame.index == 0 else None
    if given is None:
        given = initial_points(frame, source.rig, config=config, seed=seed).positions
    return similarity.points(torch.from_numpy(given))
