# SPDX-License-Identifier: Apache-2.0
"""The layout of Neural 3D Video (Li et al., CVPR 2022) and of Meet Room (Li et al., NeurIPS 2022).

One ``camXX.mp4`` (Meet Room: ``cam_X.mp4``) a camera and ``poses_bounds.npy``. Each row of the file is an LLFF pose: a
3x5 matrix ``[R | t | (height, width, focal)]``, camera to world with the axes down, right, backward, then two depth
bounds. Rows belong to the existing videos in sorted order; the first camera, ``cam00`` or ``cam_0``, is held out, as in
published results.

Published loaders lay a COLMAP model beside it, in ``sparse``, ``colmap/sparse`` or ``colmap_0/sparse``: its points come
along, moved to the poses of the file where it has a frame of its own.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.aligned_points import aligned_points
from structgstream.data.calibration import calibrated_camera, calibrated_rig
from structgstream.data.colmap import find_model, read_model
from structgstream.data.folder_files import files_of
from structgstream.data.timeline import natural
from structgstream.data.video import VideoSource, synchronised
from structgstream.data.video_index import VideoTrack, scan_videos
from structgstream.errors import CalibrationError

POSES = "poses_bounds.npy"
HELD_OUT = ("cam00", "cam_0")
MODELS = ("", "colmap", "colmap_0")


def recognizes_n3dv(path: Path) -> bool:
    """Whether the folder has this layout."""
    return (path / POSES).is_file()


def open_n3dv(path: Path) -> VideoSource:
    """The capture at ``path``. Videos smaller than the poses say are taken as uniformly reduced.

    Raises:
        CaptureError: a video cannot be read.
        CalibrationError: broken poses, not one pose per video, or a video of other proportions than its pose.
    """
    poses = _read_poses(path / POSES)
    videos = sorted(files_of(path, (".mp4",)), key=lambda video: natural(video.stem))
    if len(videos) != len(poses):
        raise CalibrationError(
            f"{path / POSES} has {len(poses)} poses, {path} has {len(videos)} mp4 files; expected one pose "
            "per video, in sorted order."
        )
    tracks = scan_videos({video.stem: video for video in videos})
    cameras = {name: _camera(name, pose, tracks[name], path / POSES) for name, pose in zip(tracks, poses)}
    rig = calibrated_rig(cameras, [name for name in HELD_OUT if name in cameras], where=path)
    return synchronised(tracks, rig, where=path, points=_points(path, rig))


def _points(path: Path, rig: CameraRig) -> NDArray[np.float64] | None:
    """Those of the COLMAP model beside the poses, if there is one that agrees with them."""
    found = next((model for name in MODELS if (model := find_model(path / name)) is not None), None)
    return None if found is None else aligned_points(read_model(found), rig)


def _read_poses(file: Path) -> NDArray[np.float64]:
    """``[V, 3, 5]`` matrices of the file."""
    try:
        rows = np.asarray(np.load(file, allow_pickle=False), dtype=np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise CalibrationError(f"{file} cannot be read as an array of numbers ({error}).") from None
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise CalibrationError(f"{file} has shape {rows.shape}; expected (cameras, 17): 3x5 poses and two bounds.")
    return rows[:, :15].reshape(-1, 3, 5)


def _camera(name: str, pose: NDArray[np.float64], track: VideoTrack, where: Path) -> Camera:
    if not np.isfinite(pose).all():
        raise CalibrationError(f"Camera {name!r} of {where} has a number that is not finite (NaN or infinity).")
    down, right, backward, center, (height, width, focal) = pose.T
    rotation = np.stack([right, down, -backward])  # rows of world to camera: x right, y down, z forward
    camera = calibrated_camera(
        name,
        viewmat=np.column_stack([rotation, -rotation @ center]),
        K=[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]],
        width=round(width),
        height=round(height),
        where=where,
    )
    if abs(track.height - height * track.width / width) > 1:
        raise CalibrationError(
            f"The video {track.path} has {track.width}x{track.height} pixels, {where} is for "
            f"{width:g}x{height:g}; expected the same proportions."
        )
    return camera.resized(track.width, track.height)
