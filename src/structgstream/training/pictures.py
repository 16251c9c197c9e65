# SPDX-License-Identifier: Apache-2.0
"""Scene-independent preprocessing of a frame's pictures: training views and their changes."""

from dataclasses import dataclass

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.training.motion import MotionConfig, detect_changes
from structgstream.training.motion_start import MotionStartConfig, flow_views
from structgstream.training.picture_change import PictureChange
from structgstream.training.views import View, training_views


@dataclass(frozen=True)
class FramePictures:
    """The training views of a frame.

    Args:
        views: in rig order.
        changes: of each of them since the previous frame; None without motion segmentation.
    """

    views: list[View]
    changes: list[PictureChange] | None


def pictures_of(
    frame: MultiViewFrame,
    rig: CameraRig,
    *,
    before: MultiViewFrame | None,
    motion: MotionConfig,
    start: MotionStartConfig,
    backend: Backend,
) -> FramePictures:
    """The pictures of ``frame``, and their changes since the frame ``before`` (None: without motion segmentation).

    Raises:
        MissingExtraError: flow is needed and OpenCV is not installed.
    """
    views = training_views(frame, rig, backend.device)
    full = motion.full_every_frames > 0 and frame.index % motion.full_every_frames == 0
    if before is None or not motion.enabled or full:
        return FramePictures(views, None)
    flow_from = flow_views(views, frame.index, start)
    earlier = training_views(before, rig, backend.device)
    return FramePictures(views, detect_changes(views, earlier, config=motion, backend=backend, flow_from=flow_from))
