# SPDX-License-Identifier: Apache-2.0
"""What a frame's fit reads of its pictures, and of the frame before's, before it looks at any scene."""

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
        changes: of each of them since the frame before; None when everything may move.
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
    """The pictures of ``frame``, and how they differ from those of the frame ``before``; None: everything may move.

    Raises:
        MissingExtraError: flow is asked for and OpenCV is not installed.
    """
    views = training_views(frame, rig, backend.device)
    full = motion.full_every_frames > 0 and frame.index % motion.full_every_frames == 0
    if before is None or not motion.enabled or full:
        return FramePictures(views, None)
    flow_from = flow_views(views, frame.index, start)
    earlier = training_views(before, rig, backend.device)
    return FramePictures(views, detect_changes(views, earlier, config=motion, backend=backend, flow_from=flow_from))
