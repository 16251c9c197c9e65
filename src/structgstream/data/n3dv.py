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

from structgstream.cameras import CameraRig
from structgstream.data.aligned_points import aligned_points
from structgstream.data.calibration_files.reading import read_array, readable
from structgstream.data.camera_files import pictures_in, roots_of, videos_in
from structgstream.data.colmap import find_model, read_model
from structgstream.data.pair_matches import PairMatcher, confirmed_share
from structgstream.data.posed import Calibration, PosedCamera, intrinsics, rigid
from structgstream.data.posed_capture import of_pictures, of_videos
from structgstream.data.source import FrameSource
from structgstream.data.text_files import pixels
from structgstream.data.timeline import natural
from structgstream.data.wrappers import resized
from structgstream.errors import CalibrationError

log = logging.getLogger(__name__)

POSES = "poses_bounds.npy"
HELD_OUT = ("cam00", "cam_0")
MODELS = ("", "colmap", "colmap_0")
SIDE = 640  # pixels, of pictures that are matched to tell the order of rows
LARGEST = 1e100  # of a number of a pose
MIN_CONFIRMED = 0.5  # of the pairs of neighbours


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

    def opened(names: Sequence[str]) -> FrameSource:
        posed = {name: _camera(name, pose, path / POSES) for name, pose in zip(names, poses, strict=True)}
        posed = {name: posed[name] for name in sorted(posed, key=natural)}
        held_out = [name for name in HELD_OUT if name in posed]
        calibration = Calibration(path / POSES, tuple(posed.values()), held_out=held_out)
        if videos:
            return of_videos(path, videos, root=path, calibration=calibration)[0]
        return of_pictures(path, pictures, posed, root=path, calibration=calibration)[0]

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
        shares.append(confirmed_share(cameras, matcher))
    if max(shares) < MIN_CONFIRMED or shares[0] == shares[1]:
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
    with readable(file, "3x5 poses and two bounds of each camera"):
        rows = read_array(file)
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
