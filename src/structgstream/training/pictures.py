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
        views: in rig order, without absent cameras.
        changes: of each of them since the previous frame, None for a camera that was absent from that; None without
            motion segmentation.
    """

    views: list[View]
    changes: list[PictureChange | None] | None


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

    With fewer cameras in both frames than a mover needs votes there is no motion segmentation: everything is trained.

    Raises:
        MissingExtraError: flow is needed and OpenCV is not installed.
    """
    views = training_views(frame, rig, backend.device)
    full = motion.full_every_frames > 0 and frame.index % motion.full_every_frames == 0
    if before is None or not motion.enabled or full:
        return FramePictures(views, None)
    earlier = training_views(before, rig, backend.device)
    known = {view.index for view in earlier}
    compared = [view for view in views if view.index in known]
    if len(compared) < min(motion.least_views, len(rig.training)):
        return FramePictures(views, None)
    flow_from = flow_views(compared, frame.index, start)
    changes = detect_changes(views, earlier, config=motion, backend=backend, flow_from=flow_from, flow=start.flow)
    return FramePictures(views, changes)
