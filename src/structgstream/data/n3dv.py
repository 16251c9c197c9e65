# SPDX-License-Identifier: Apache-2.0
"""The layout of Neural 3D Video (Li et al., CVPR 2022) and of Meet Room (Li et al., NeurIPS 2022).

One ``camXX.mp4`` (Meet Room: ``cam_X.mp4``) a camera, or, decoded for 4DGaussians, ``camXX/images/FRAME.png``,
and ``poses_bounds.npy``. Each row of the file is an LLFF pose: a
3x5 matrix ``[R | t | (height, width, focal)]``, camera to world with the axes down, right, backward, then two depth
bounds. Rows belong to the existing videos in sorted order; the first camera, ``cam00`` or ``cam_0``, is held out, as in
published results.

Note [Order of rows]

Meet Room's rows follow the numbers of ``cam_2`` and ``cam_10``; LLFF sorts names as text, ``cam_10`` first. Where the
two differ the pictures decide: the order in which more pairs of neighbours agree with the poses.

Published loaders lay a COLMAP model beside it, in ``sparse``, ``colmap/sparse`` or ``colmap_0/sparse``: its points come
along, moved to the poses of the file where it has a frame of its own.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.aligned_points import aligned_points
from structgstream.data.calibration import calibrated_camera, calibrated_rig
from structgstream.data.calibration_files.reading import read_array, readable
from structgstream.data.camera_files import pictures_in, roots_of, videos_in
from structgstream.data.colmap import find_model, read_model
from structgstream.data.pair_matches import PairMatcher
from structgstream.data.pose_check import PoseCheckConfig, confirmed_share
from structgstream.data.posed import Calibration, PosedCamera, intrinsics, rigid
from structgstream.data.posed_capture import of_pictures
from structgstream.data.source import FrameSource
from structgstream.data.text_files import BROKEN, pixels, reason
from structgstream.data.timeline import natural
from structgstream.data.video import synchronised
from structgstream.data.video_index import VideoTrack, scan_videos
from structgstream.data.wrappers import resized
from structgstream.errors import CalibrationError

log = logging.getLogger(__name__)

POSES = "poses_bounds.npy"
HELD_OUT = ("cam00", "cam_0")
MODELS = ("", "colmap", "colmap_0")
SIDE = 640  # pixels, of pictures that are matched to tell the order of rows
LARGEST = 1e100  # of a number of a pose
LEAST_CONFIRMED = 0.5  # of the pairs of neighbours


def recognizes_n3dv(path: Path) -> bool:
    """Whether the folder has this layout."""
    return (path / POSES).is_file()


def open_n3dv(path: Path) -> FrameSource:
    """The capture at ``path``. Videos smaller than the poses say are taken as uniformly reduced.

    Raises:
        CaptureError: a video or picture cannot be read.
        CalibrationError: broken poses, not one pose per video, or a video of other proportions than its pose.
    """
    poses = _read_poses(path / POSES)
    videos = next(filter(None, map(videos_in, roots_of(path))), {})
    pictures = {} if videos else next(filter(None, map(pictures_in, roots_of(path))), {})
    names = sorted(videos or pictures, key=natural)
    if len(names) != len(poses):
        raise CalibrationError(
            f"{path / POSES} has {len(poses)} poses, {path} has {len(names)} {'videos' if videos else 'cameras'}; "
            "expected one pose per camera, in sorted order."
        )
    tracks = scan_videos({name: videos[name] for name in names}) if videos else {}

    def opened(names: Sequence[str]) -> FrameSource:
        posed = {name: _camera(name, pose, path / POSES) for name, pose in zip(names, poses, strict=True)}
        posed = {name: posed[name] for name in sorted(posed, key=natural)}
        held_out = [name for name in HELD_OUT if name in posed]
        if not tracks:
            calibration = Calibration(path / POSES, tuple(posed.values()), held_out=held_out)
            return of_pictures(path, pictures, posed, root=path, calibration=calibration)[0]
        cameras = {name: _sized(posed[name], tracks[name], path / POSES) for name in posed}
        return synchronised(tracks, calibrated_rig(cameras, held_out, where=path), where=path)

    source = opened(names)
    if names != sorted(names) and _as_text(source, opened(sorted(names)).rig):
        log.info(
            "%s: its rows are in the order of the names as text (cam1, cam10, cam2), as the pictures say", path / POSES
        )
        source = opened(sorted(names))
    return replace(source, points=_points(path, source.rig))  # type: ignore[type-var]


def _as_text(by_number: FrameSource, as_text: CameraRig) -> bool:
    """Whether the pictures of frame 0 agree with the second rig rather than the first; see Note [Order of rows]."""
    training = {name: by_number.rig[name] for name in by_number.rig.training}
    width = max(camera.width for camera in training.values())
    small = resized(by_number, min(1.0, SIDE / width))
    frame = next(iter(small.frames()))
    names = list(frame.showing(small.rig.training))
    matcher = PairMatcher({name: frame.images[name] for name in names})
    shares = []
    for rig in (by_number.rig, as_text):
        cameras = {name: rig[name].resized(small.rig[name].width, small.rig[name].height) for name in names}
        shares.append(confirmed_share(cameras, matcher, PoseCheckConfig()))
    if max(shares) < LEAST_CONFIRMED or shares[0] == shares[1]:
        log.warning(
            "%s: the pictures do not say whether the rows of %s follow the names by number or as text; by "
            "number is taken. Names with leading zeros (cam01) are clear.",
            by_number.name, POSES,
        )  # fmt: skip
        return False
    return shares[1] > shares[0]


def _points(path: Path, rig: CameraRig) -> NDArray[np.float64] | None:
    """Those of the COLMAP model beside the poses, if there is one that agrees with them."""
    found = next((model for name in MODELS if (model := find_model(path / name)) is not None), None)
    return None if found is None else aligned_points(read_model(found), rig)


def _read_poses(file: Path) -> NDArray[np.float64]:
    """``[V, 3, 5]`` matrices of the file."""
    try:
        rows = read_array(file)
    except BROKEN as error:
        raise CalibrationError(f"{file} cannot be read ({reason(error)}); copy or export it again.") from None
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise CalibrationError(f"{file} has shape {rows.shape}; expected (cameras, 17): 3x5 poses and two bounds.")
    return rows[:, :15].reshape(-1, 3, 5)


def _camera(name: str, pose: NDArray[np.float64], where: Path) -> PosedCamera:
    if not (np.abs(pose) < LARGEST).all():
        raise CalibrationError(f"Camera {name!r} of {where} has a number that is not finite (NaN or infinity).")
    down, right, backward, center, (height, width, focal) = pose.T
    rotation = np.stack([right, down, -backward])  # rows of world to camera: x right, y down, z forward
    with readable(where, "3x5 poses with height, width and focal length"):
        size = pixels((width, height))
    return PosedCamera(name, rigid(rotation, -rotation @ center), intrinsics(focal, focal, width / 2, height / 2), size)


def _sized(posed: PosedCamera, track: VideoTrack, where: Path) -> Camera:
    assert posed.size is not None
    width, height = posed.size
    camera = calibrated_camera(posed.name, viewmat=posed.viewmat, K=posed.K, width=width, height=height, where=where)
    if abs(track.height - height * track.width / width) > 1:
        raise CalibrationError(
            f"The video {track.path} has {track.width}x{track.height} pixels, {where} is for "
            f"{width:g}x{height:g}; expected the same proportions."
        )
    return camera.resized(track.width, track.height)
