# SPDX-License-Identifier: Apache-2.0
"""Camera paths that stay within the rig's views, in the capture's units."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.errors import ConfigError

ORBIT_SHARE = 0.5  # of the distance to the nearest cameras; farther out, surfaces were seen from one side only
NEIGHBOURS = 3
ARC_HALF_ANGLE = math.radians(50.0)
MIN_NEAR_SHARE = 0.01
"""A free camera's near plane is at least this share of its nearest camera's, because nearer content is blurred."""


def focus_point(rig: CameraRig) -> Tensor:
    """The point ``[3]`` nearest to all optical axes.

    For nearly parallel axes it lies in front of the cameras' mean position, at a distance of the rig's size.
    """
    cameras = list(rig.cameras.values())
    centers = rig.centers
    axes = torch.stack([camera.viewmat[2, :3] for camera in cameras])  # [V, 3]
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    spread = (centers - centers.mean(0)).norm(dim=1).max()
    if torch.linalg.eigvalsh(normal)[0] > 1e-3 * len(cameras):
        point = torch.linalg.solve(normal, (across @ centers[:, :, None]).sum(0)[:, 0])
        ahead = ((point - centers) * axes).sum(1)
        if bool((ahead > 0).float().mean() > 0.5):
            return point
    forward = torch.nn.functional.normalize(axes.mean(0), dim=0)
    return centers.mean(0) + forward * 2.0 * spread


def orbit(rig: CameraRig, frames: int, *, around: str | None = None) -> list[Camera]:
    """A flat ellipse of ``frames`` cameras around a camera of the rig, by default the one nearest to its mean, directed
    at the point in the centre of that camera's picture; the last is one step before the first. Raises ConfigError if
    the camera is unknown."""
    name = central_camera(rig) if around is None else _known(rig, around)
    camera = rig[name]
    right, down, forward = camera.viewmat[:3, :3]
    distances = (rig.centers - camera.center).norm(dim=1).sort().values[1 : 1 + NEIGHBOURS]
    radius = ORBIT_SHARE * float(distances.mean())
    depth = float((focus_point(rig) - camera.center) @ forward)
    target = camera.center + forward * max(depth, 2.0 * radius)
    path = []
    for index in range(frames):
        angle = 2.0 * math.pi * index / frames
        eye = camera.center + radius * (math.sin(angle) * right - 0.5 * math.cos(angle) * down)
        path.append(looking(camera, eye, target, down, rig))
    return path


def arc(rig: CameraRig, frames: int, *, between: tuple[str, str] | None = None) -> list[Camera]:
    """A path from one camera of the rig to another, at interpolated distances from the focus point; by default between
    the two most distant cameras within 50 degrees of the middle camera. Raises ConfigError if a camera is unknown."""
    focus = focus_point(rig)
    names = _ends(rig, focus) if between is None else (_known(rig, between[0]), _known(rig, between[1]))
    first, last = (rig[name] for name in names)
    start, end = first.center - focus, last.center - focus
    down = torch.nn.functional.normalize(first.viewmat[1, :3] + last.viewmat[1, :3], dim=0)
    path = []
    for index in range(frames):
        share = index / max(frames - 1, 1)
        length = (1.0 - share) * start.norm() + share * end.norm()
        path.append(looking(first, focus + length * _between(start, end, share), focus, down, rig))
    return path


def looking(camera: Camera, eye: Tensor, target: Tensor, down: Tensor, rig: CameraRig) -> Camera:
    """``camera`` moved to ``eye`` and directed at ``target``; ``down`` is its vertical axis (``[3]`` each, world)."""
    return replace(camera, viewmat=look_at(eye, target, down), near=free_near(rig, eye))


def look_at(eye: Tensor, target: Tensor, down: Tensor) -> Tensor:
    """World to camera ``[4, 4]`` at ``eye``, directed at ``target``, with the vertical axis ``down`` (``[3]`` each)."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(down, forward), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return viewmat


def free_near(rig: CameraRig, eye: Tensor) -> float:
    """The near plane of a free camera at ``eye`` ``[3]``: that of the nearest camera of the rig.

    It stays where it is if the free camera advances along that camera's axis. Beside the cameras it keeps its distance:
    between the cameras of a dome, the eye is in the wall that other cameras see.
    """
    nearest = list(rig.cameras.values())[int((rig.centers - eye).norm(dim=1).argmin())]
    advance = float((eye - nearest.center) @ nearest.viewmat[2, :3])
    return max(nearest.near - max(advance, 0.0), MIN_NEAR_SHARE * nearest.near)


def central_camera(rig: CameraRig) -> str:
    """The camera nearest to the mean position of the training cameras."""
    mean = torch.stack([rig[name].center for name in rig.training]).mean(0)
    return min(rig, key=lambda name: float((rig[name].center - mean).norm()))


def _between(start: Tensor, end: Tensor, share: float) -> Tensor:
    """The unit vector ``share`` of the way from the direction of ``start`` to that of ``end``."""
    a, b = (torch.nn.functional.normalize(v, dim=0) for v in (start, end))
    angle = torch.arccos((a @ b).clamp(-1.0, 1.0))
    if angle < 1e-6:
        return a
    return (torch.sin((1.0 - share) * angle) * a + torch.sin(share * angle) * b) / torch.sin(angle)


def _ends(rig: CameraRig, focus: Tensor) -> tuple[str, str]:
    middle = torch.nn.functional.normalize(rig[central_camera(rig)].center - focus, dim=0)
    directions = {name: torch.nn.functional.normalize(rig[name].center - focus, dim=0) for name in rig.training}
    near = [name for name, d in directions.items() if float(d @ middle) >= math.cos(ARC_HALF_ANGLE)]
    if len(near) < 2:
        near = sorted(directions, key=lambda name: -float(directions[name] @ middle))[:2]
    pairs = [(a, b) for i, a in enumerate(near) for b in near[i + 1 :]]
    return min(pairs, key=lambda pair: float(directions[pair[0]] @ directions[pair[1]]))


def _known(rig: CameraRig, name: str) -> str:
    if name not in rig.cameras:
        raise ConfigError(f"There is no camera {name!r}; the rig has {', '.join(rig)}.")
    return name
