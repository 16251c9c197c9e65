# SPDX-License-Identifier: Apache-2.0
"""Layouts of published data sets that have a calibration file of their own, by which they are recognised
(docs/captures.md has which cameras they hold out).

What a layout asks for and a capture lacks is a ``CaptureError``, broken numbers are a ``CalibrationError``.

PanopticSports of Dynamic 3D Gaussians (Luiten et al., 3DV 2024): ``train_meta.json`` and ``test_meta.json`` have ``w``,
``h`` and, per frame and camera, ``k``, ``w2c`` (OpenCV world to camera), ``fn`` (file below ``ims/``) and ``cam_id``.

Google Immersive (Broxton et al., SIGGRAPH 2020): each entry of ``models.json`` has ``name``, ``width``, ``height``,
``focal_length``, ``principal_point``, ``radial_distortion`` (OpenCV's fisheye; the first two are used, as published
loaders do), ``orientation`` (a rotation vector, world to camera) and ``position`` (of the camera in the world).
Published results undistort to pinholes of half the focal length; so does this reader. Pixels outside of the lens's
picture are black.

Neural 3D Video (Li et al., CVPR 2022) and Meet Room (Li et al., NeurIPS 2022): each row of ``poses_bounds.npy`` is an
LLFF pose: a 3x5 matrix ``[R | t | (height, width, focal)]``, camera to world with the axes down, right, backward, then
two depth bounds. Rows belong to the existing videos in sorted order. The points of a COLMAP model are transformed to
these poses.

``cameras.json``, in OpenCV axes, has two dialects. The package's own, as of the bundled clip: ``{"width", "height",
"fps", "frames", "near", "held_out": [names], "cameras": {name: {"K": 3x3, "viewmat": 4x4 world to camera}}}`` with
``name.mp4``. Of shared intrinsics: ``{"w", "h", "fl_x", "fl_y", "cx", "cy", "cams": [4x4 camera to world, ...]}`` with
``cam00.mp4``, ``cam01.mp4``, ... in the order of ``cams``.

Note [Order of rows]
~~~~~~~~~~~~~~~~~~~~
Meet Room's rows follow the numbers of ``cam_2`` and ``cam_10``; LLFF sorts names as text, ``cam_10`` first. Where the
two differ the pictures decide: the order in which more pairs of neighbours agree with the poses.
"""

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.calibration import (
    Calibration,
    PosedCamera,
    alignment,
    at_picture_size,
    calibrated_camera,
    calibrated_rig,
    calibration_of,
    check_held_out,
    check_names,
    intrinsics,
    rigid,
    rotation_matrix,
)
from structgstream.data.camera_files import pictures_in, roots_of, videos_in
from structgstream.data.colmap import find_model, read_model
from structgstream.data.images import PICTURE_SUFFIXES, ImageSource, common_pictures
from structgstream.data.lenses import LensCamera, fisheye_lens, from_integer_centers
from structgstream.data.matching import PairMatcher, confirmed_share
from structgstream.data.posed_capture import of_pictures, of_videos, open_posed, stills_of
from structgstream.data.source import FrameSource, resized
from structgstream.data.text_files import (
    NamedFiles,
    mapping,
    number,
    path_parts,
    pixels,
    positive,
    read_array,
    read_json,
    readable,
    whole,
)
from structgstream.data.timeline import natural
from structgstream.data.video import VideoSource, synchronised
from structgstream.data.video_index import scan_videos
from structgstream.errors import CalibrationError, CaptureError

PANOPTIC_FPS = 30000 / 1001
TRAIN, TEST = "train_meta.json", "test_meta.json"


def open_panoptic(path: Path) -> ImageSource:
    """The capture at ``path``."""
    cameras: dict[str, Camera] = {}
    files: dict[str, dict[str, Path]] = {}
    held_out: list[str] = []
    for meta in (path / TRAIN, path / TEST):
        if not meta.is_file():
            continue
        found, pictures = _read_meta(meta)
        if both := sorted(found.keys() & cameras.keys(), key=natural):
            raise CaptureError(f"Camera {both[0]!r} is in both {TRAIN} and {TEST} of {path}; keep it in one.")
        cameras |= found
        files |= pictures
        if meta.name == TEST:
            held_out += found
    rig = calibrated_rig({name: cameras[name] for name in sorted(cameras, key=natural)}, held_out, where=path)
    common, instants = common_pictures({name: files[name] for name in rig}, where=path, training=rig.training)
    return ImageSource(path.name, rig, PANOPTIC_FPS, common, instants=instants)


def _read_meta(meta: Path) -> tuple[dict[str, Camera], dict[str, dict[str, Path]]]:
    """Cameras of one file, and those pictures of each that exist, by the name of the instant."""
    with readable(meta, "w, h, k, w2c, fn and cam_id, the last four as lists over frames and cameras"):
        content = mapping(read_json(meta))
        size = pixels((content["w"], content["h"]))
        pictures = NamedFiles(meta.parent / "ims", PICTURE_SUFFIXES)
        rows = []
        for frame in zip(content["cam_id"], content["k"], content["w2c"], content["fn"], strict=True):
            for name, K, viewmat, file in zip(*frame, strict=True):
                # The path below ``ims`` may name that and what is above it.
                picture = pictures.find(str(file)) or pictures.find("/".join(path_parts(str(file))[-2:]))
                rows.append((str(name), (K, viewmat), file, picture))
    first: dict[str, tuple[Any, Any]] = {}
    files: dict[str, dict[str, Path]] = {}
    for name, matrices, file, picture in rows:
        known = first.setdefault(name, matrices)
        if known != matrices and not _same(known, matrices):
            raise CalibrationError(
                f"Camera {name!r} of {meta} moves: its k or w2c changes at {file}; expected cameras that stand still."
            )
        own = files.setdefault(name, {})
        if picture is not None:
            own[picture.stem] = picture
    cameras = {
        name: calibrated_camera(name, viewmat=viewmat, K=K, size=size, where=meta)
        for name, (K, viewmat) in first.items()
    }
    return cameras, files


def _same(a: tuple[Any, Any], b: tuple[Any, Any]) -> bool:
    """Whether two pairs of matrices agree up to rounding; NaN agrees with NaN, which the camera refuses."""
    with suppress(TypeError, ValueError):
        pairs = [(np.array(x, float), np.array(y, float)) for x, y in zip(a, b)]
        return all(np.allclose(x, y, rtol=1e-6, atol=1e-9, equal_nan=True) for x, y in pairs)
    return False


MODELS_FILE = "models.json"
IMMERSIVE_HELD_OUT = "camera_0001"
FOCAL_SHARE = 0.5
IMMERSIVE_EXPECTED = (
    "a list of cameras with name, width, height, focal_length, principal_point, radial_distortion, orientation "
    "and position"
)


def open_immersive(path: Path) -> FrameSource:
    """The capture at ``path``, undistorted; a video without calibration, which some takes have, is left out."""
    return open_posed(path, read_models(path / MODELS_FILE), target=_as_published, complete=False)


def _as_published(filmed: LensCamera) -> Camera:
    shares = torch.tensor([[FOCAL_SHARE, 1, 1], [1, FOCAL_SHARE, 1], [1, 1, 1]], dtype=torch.float64)
    return replace(filmed.camera, K=filmed.camera.K * shares)


def read_models(file: Path) -> Calibration:
    """The cameras of ``models.json``."""
    with readable(file, IMMERSIVE_EXPECTED):
        entries = [(str(entry["name"]), entry) for entry in read_json(file)]
    found = calibration_of(entries, _immersive_camera, file=file, expected=IMMERSIVE_EXPECTED)
    return replace(found, held_out=[camera.name for camera in found.cameras if camera.name == IMMERSIVE_HELD_OUT])


def _immersive_camera(name: str, entry: dict[str, Any]) -> PosedCamera:
    focal, (cx, cy) = number(entry["focal_length"]), entry["principal_point"]
    rotation = rotation_matrix(np.array(entry["orientation"], dtype=np.float64).reshape(3))
    viewmat = rigid(rotation, -rotation @ np.array(entry["position"], dtype=np.float64))
    K = from_integer_centers(intrinsics(focal, focal * number(entry.get("pixel_aspect_ratio", 1)), cx, cy))
    size = pixels((entry["width"], entry["height"]))
    return PosedCamera(name, viewmat, K, size, fisheye_lens(entry["radial_distortion"][:2]))


log = logging.getLogger(__name__)

POSES = "poses_bounds.npy"
N3DV_HELD_OUT = ("cam00", "cam_0")
COLMAP_FOLDERS = ("", "colmap", "colmap_0")
SIDE = 640  # pixels, of pictures that are matched to find the order of rows
LARGEST = 1e100  # of a number of a pose
MIN_CONFIRMED = 0.5  # of the pairs of neighbours


def open_n3dv(path: Path) -> FrameSource:
    """The capture at ``path``. Videos smaller than the size of the poses are taken as uniformly reduced."""
    poses = _read_llff_poses(path / POSES)
    videos = next(filter(None, map(videos_in, roots_of(path))), {})
    pictures = {} if videos else next(filter(None, map(pictures_in, roots_of(path))), {})
    if not videos and not pictures and (stills := stills_of(path)):  # of LLFF and mip-NeRF 360
        pictures = {name: {"0": file} for name, file in stills[0][1].items()}
    names = sorted(videos or pictures, key=natural)
    if len(names) != len(poses):
        raise CalibrationError(
            f"{path / POSES} has {len(poses)} poses, {path} has {len(names)} {'videos' if videos else 'cameras'}; "
            "expected a video, a folder of pictures or a picture per pose, in sorted order."
        )

    def opened(names: Sequence[str]) -> FrameSource:
        posed = {name: _n3dv_camera(name, pose, path / POSES) for name, pose in zip(names, poses, strict=True)}
        posed = {name: posed[name] for name in sorted(posed, key=natural)}
        held_out = [name for name in N3DV_HELD_OUT if name in posed]
        calibration = Calibration(path / POSES, tuple(posed.values()), held_out=held_out)
        if videos:
            return of_videos(path, videos, root=path, calibration=calibration)[0]
        return of_pictures(path, pictures, posed, root=path, calibration=calibration)[0]

    source = opened(names)
    if names != sorted(names) and _as_text(source, as_text := opened(sorted(names))):
        text = "%s: its rows are in the order of the names as text (cam1, cam10, cam2), as the pictures say"
        log.info(text, path / POSES)
        source = as_text
    model = next((model for name in COLMAP_FOLDERS if (model := find_model(path / name)) is not None), None)
    points = None if model is None else aligned_points(read_model(model), source.rig)
    return replace(source, points=points)  # type: ignore[type-var]


def _as_text(by_number: FrameSource, as_text: FrameSource) -> bool:
    """Whether the pictures of frame 0 agree with the second rig rather than the first; see Note [Order of rows]."""
    rig = by_number.rig
    scale = min(1.0, SIDE / max(rig[name].width for name in rig.training))
    frame = next(iter(resized(by_number, scale).frames()))
    names = list(frame.showing(rig.training))
    matcher = PairMatcher({name: frame.images[name] for name in names})
    shares = [
        confirmed_share({name: source.rig[name].scaled(scale) for name in names}, matcher)
        for source in (by_number, as_text)
    ]
    if max(shares) < MIN_CONFIRMED or shares[0] == shares[1]:
        log.warning(
            "%s: the pictures do not say whether the rows of %s follow the names by number or as text; by "
            "number is taken. Names with leading zeros (cam01) are clear.",
            by_number.name, POSES,
        )  # fmt: skip
        return False
    return shares[1] > shares[0]


def _read_llff_poses(file: Path) -> NDArray[np.float64]:
    """``[V, 3, 5]`` matrices of the file."""
    with readable(file, "3x5 poses and two bounds of each camera"):
        rows = read_array(file)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise CalibrationError(f"{file} has shape {rows.shape}; expected (cameras, 17): 3x5 poses and two bounds.")
    return rows[:, :15].reshape(-1, 3, 5)


def _n3dv_camera(name: str, pose: NDArray[np.float64], where: Path) -> PosedCamera:
    if not (np.abs(pose) < LARGEST).all():
        raise CalibrationError(f"Camera {name!r} of {where} has a number that is not finite (NaN or infinity).")
    down, right, backward, center, (height, width, focal) = pose.T
    rotation = np.stack([right, down, -backward])  # rows of world to camera: x right, y down, z forward
    with readable(where, "3x5 poses with height, width and focal length"):
        size = pixels((width, height))
    return PosedCamera(name, rigid(rotation, -rotation @ center), intrinsics(focal, focal, width / 2, height / 2), size)


CAMERAS_FILE = "cameras.json"


def open_json_videos(path: Path) -> VideoSource:
    """The capture at ``path``."""
    file = path / CAMERAS_FILE
    rig, fps, stated_frames = read_cameras(file)
    videos = next(filter(None, map(videos_in, roots_of(path))), {})
    check_names(list(rig), sorted(videos, key=natural), calibration=file, pictures=path)
    tracks = scan_videos({name: videos[name] for name in rig})
    cameras = {
        name: at_picture_size(rig[name], (track.width, track.height), name=name, where=file)
        for name, track in tracks.items()
    }
    source = synchronised(tracks, replace(rig, cameras=cameras), where=path, fps=fps)
    if len(source) < stated_frames:
        raise CaptureError(
            f"The videos of {path} share {len(source)} frames, {CAMERAS_FILE} states {stated_frames}; "
            "copy the capture again or correct the number."
        )
    return source


def read_cameras(file: Path) -> tuple[CameraRig, float | None, int]:
    """The rig of a ``cameras.json``, its frames a second (None if not stated) and the number of frames."""
    with readable(file, "width, height and cameras with K and viewmat, or w, h, fl_x, fl_y, cx, cy and cams"):
        content = mapping(read_json(file))
        rig = _own_rig(content, file) if "cameras" in content else _shared_intrinsics_rig(content, file)
        return rig, positive(content, "fps") if "fps" in content else None, whole(content.get("frames", 1))


def _own_rig(content: dict[str, Any], file: Path) -> CameraRig:
    size = pixels((content["width"], content["height"]))
    cameras = {
        name: calibrated_camera(name, viewmat=entry["viewmat"], K=entry["K"], size=size, where=file)
        for name, entry in mapping(content["cameras"]).items()
    }
    near = positive(content, "near") if "near" in content else None
    check_held_out(held_out := content.get("held_out", ()), cameras, where=file)
    return calibrated_rig(cameras, held_out, where=file, near=near)


def _shared_intrinsics_rig(content: dict[str, Any], file: Path) -> CameraRig:
    K = [[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]]
    size = pixels((content["w"], content["h"]))
    cameras: dict[str, Camera] = {}
    for index, pose in enumerate(content["cams"]):
        name = f"cam{index:02d}"
        with readable(f"Camera {name!r} of {file}", "a pose of 4x4 numbers that can be inverted"):
            viewmat = np.linalg.inv(np.array(pose, dtype=np.float64).reshape(4, 4))
        cameras[name] = calibrated_camera(name, viewmat=viewmat, K=K, size=size, where=file)
    return calibrated_rig(cameras, ("cam00",), where=file)


def bundled_clip_path() -> Path:
    """The folder of the bundled clip.

    Raises:
        CaptureError: the installation lacks the clip.
    """
    folder = Path(str(files("structgstream.data") / "clip"))
    if not (folder / CAMERAS_FILE).is_file():
        raise CaptureError("The bundled clip is missing from the installation; reinstall structgstream.")
    return folder


def bundled_clip() -> FrameSource:
    """The bundled clip, as a capture."""
    return open_json_videos(bundled_clip_path())


MIN_COMMON = 3
MAX_OFF = 0.03
"""Largest residual of a camera position after alignment, as a share of the extent of the cameras that match."""


def aligned_points(model: Calibration, rig: CameraRig) -> NDArray[np.float64] | None:
    """The points ``[P, 3]`` of ``model`` in the coordinates of ``rig``, by the similarity that aligns its cameras.

    None, with a warning, if too few cameras match by name or their positions do not agree.
    """
    if model.points is None:
        return None
    found: dict[str, PosedCamera] = {}  # whose camera's name is a part of a picture's
    for posed in model.cameras:
        parts = PurePosixPath(posed.name).with_suffix("").parts
        if name := next((part for part in parts if part in rig.cameras), None):
            found.setdefault(name, posed)
    if len(found) < MIN_COMMON:
        text = "%s has %d cameras of the rig by name; its points are not used. Its pictures need the cameras' names."
        log.warning(text, model.where, len(found))
        return None
    fitted = alignment(
        {name: posed.viewmat for name, posed in found.items()}, {name: rig[name].viewmat.numpy() for name in found}
    )
    theirs = np.array([posed.center for posed in found.values()])
    ours = np.array([rig[name].center.numpy() for name in found])
    off = np.linalg.norm(fitted.points(theirs) - ours, axis=1).max() / np.linalg.norm(np.ptp(ours, axis=0))
    if not off <= MAX_OFF:
        text = "The cameras of %s lie up to %.0f %% of their extent away from the rig's; its points are not used."
        log.warning(text, model.where, 100 * off)
        return None
    return fitted.points(model.points)
