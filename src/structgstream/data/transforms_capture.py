# SPDX-License-Identifier: Apache-2.0
"""Captures with a ``transforms.json``: pictures with times, the two files of Blender, or names of cameras alone.

Pictures of one pose are of one camera. Where each has a ``time``, the instants are the times; without, pictures and
videos are looked for by the cameras' names, as with other calibrations, so that a file of one instant serves for all.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from structgstream.data.calibration_files.transforms import WHOLE, Shot, find, read, read_shots, stated_fps
from structgstream.data.posed import Calibration
from structgstream.data.posed_capture import of_pictures, open_posed
from structgstream.data.source import FrameSource
from structgstream.data.undistortion import undistort
from structgstream.errors import CalibrationError

SAME = 6  # digits in which poses of one camera agree

Cameras = Mapping[str, Sequence[Shot]]


def recognizes_transforms(path: Path) -> bool:
    """Whether the folder has this layout."""
    return bool(find(path))


def open_transforms(path: Path) -> FrameSource:
    """The capture at ``path``; what ``transforms_test.json`` lists is held out.

    Raises:
        CaptureError: a picture is missing or cannot be read.
        CalibrationError: a broken file, or a camera that moves.
    """
    files = find(path)
    shots = read_shots(files)
    if files[0].name == WHOLE and any(shot.time is None for shot in shots):
        return open_posed(path, read(files), fps=stated_fps(files[0]))
    cameras = _by_pose(shots, files[0])
    pictures = {name: _instants(own) for name, own in cameras.items()}
    poses = {name: own[0].camera for name, own in cameras.items()}
    held_out = [name for name, own in cameras.items() if own[0].held_out]
    calibration = Calibration(files[0], tuple(poses.values()), held_out=held_out)
    source, filmed = of_pictures(path, pictures, poses, root=path, calibration=calibration, fps=stated_fps(files[0]))
    return undistort(source, filmed)


def _by_pose(shots: Sequence[Shot], where: Path) -> Cameras:
    """The pictures of each camera, by a name that its files share."""
    groups: dict[tuple[float, ...], list[Shot]] = {}
    for shot in shots:
        camera = shot.camera
        key = (*camera.viewmat.round(SAME).ravel().tolist(), *camera.K.round(3).ravel().tolist(), shot.held_out)
        groups.setdefault(key, []).append(shot)
    if len({shot.time for shot in shots}) > 1 and all(len(own) == 1 for own in groups.values()):
        raise CalibrationError(
            f"Every picture of {where} has a pose and a time of its own: one camera that moves; expected several that "
            "stand still."
        )
    listed = list(groups.values())
    for part in ("parent", "stem"):
        names = [{_part(shot.file, part) for shot in own} for own in listed]
        if all(len(name) == 1 for name in names) and len(set.union(*names)) == len(listed):
            return dict(zip(sorted(set.union(*names)), _sorted(listed, part), strict=True))
    return {f"cam{number:02d}": own for number, own in enumerate(listed)}


def _part(file: Path, part: str) -> str:
    return file.parent.name if part == "parent" else file.stem


def _sorted(groups: Sequence[list[Shot]], part: str) -> list[list[Shot]]:
    return sorted(groups, key=lambda own: _part(own[0].file, part))


def _instants(shots: Sequence[Shot]) -> dict[str, Path]:
    """The pictures of a camera by time, or by the part of their names that differs."""
    if all(shot.time is not None for shot in shots):
        return {f"{shot.time:.6f}": shot.file for shot in shots}
    if len(shots) == 1:
        return {"0": shots[0].file}
    part = "stem" if len({shot.file.stem for shot in shots}) == len(shots) else "parent"
    return {_part(shot.file, part): shot.file for shot in shots}
