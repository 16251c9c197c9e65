# SPDX-License-Identifier: Apache-2.0
"""Small rigs and scenes that several tests look at."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.evaluation import camera_path
from structgstream.kernels.values import HeadWeights, MLPWeights
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene


def look_at(eye: Tensor, target: Tensor) -> Tensor:
    """World-to-camera matrix of a camera at ``eye`` that looks at ``target``; world y points down."""
    return camera_path.look_at(eye, target, torch.tensor([0.0, 1.0, 0.0], dtype=eye.dtype))


def arc_rig(cameras: int = 4, *, width: int = 48, height: int = 32, radius: float = 3.0) -> CameraRig:
    """Cameras on an arc around the origin; the first is held out."""
    found = {}
    for i in range(cameras):
        angle = torch.tensor(0.8 * (i / (cameras - 1) - 0.5), dtype=torch.float64)
        eye = torch.stack([radius * angle.sin(), torch.tensor(-0.3, dtype=torch.float64), -radius * angle.cos()])
        K = torch.tensor([[40.0, 0, width / 2], [0, 40.0, height / 2], [0, 0, 1]], dtype=torch.float64)
        found[f"cam{i:02d}"] = Camera(look_at(eye, torch.zeros(3, dtype=torch.float64)), K, width, height, near=0.1)
    return CameraRig(found, held_out=frozenset({"cam00"}))


def ring(degrees: Sequence[float], *, radius: float = 3.0) -> dict[str, Camera]:
    """Cameras around the origin at these angles, that look at it."""
    like, middle = arc_rig()["cam00"], torch.zeros(3, dtype=torch.float64)
    eyes = [
        torch.tensor([radius * math.sin(angle), 0.0, -radius * math.cos(angle)], dtype=torch.float64)
        for angle in map(math.radians, degrees)
    ]
    return {f"cam{i:02d}": replace(like, viewmat=look_at(eye, middle)) for i, eye in enumerate(eyes)}


def evenly(count: int, apart: float) -> dict[str, Camera]:
    """A ring of ``count`` cameras, ``apart`` degrees from one to the next."""
    return ring([apart * i for i in range(count)])


def random_scene(anchors: int = 40, *, free: int = 0, cameras: int = 3, seed: int = 0, width: int = 32) -> Scene:
    """A scene of random anchors in the unit ball, about half of whose Gaussians are drawn."""
    g = torch.Generator().manual_seed(seed)
    k, inputs = 5, width + 4

    def head(outputs: int) -> HeadWeights:
        return HeadWeights(
            torch.randn(32, inputs, generator=g) * 0.3,
            torch.randn(32, generator=g) * 0.1,
            torch.randn(outputs, 32, generator=g) * 0.3,
            torch.randn(outputs, generator=g) * 0.1,
        )

    births = torch.arange(free, dtype=torch.int64)
    return Scene(
        anchors=AnchorCloud(
            positions=torch.randn(anchors, 3, generator=g) * 0.4,
            log_offset_scales=torch.randn(anchors, 3, generator=g) * 0.1 - 2.5,
            log_base_scales=torch.randn(anchors, 3, generator=g) * 0.1 - 2.0,
            offsets=torch.randn(anchors, k, 3, generator=g),
            features=torch.randn(anchors, width, generator=g),
        ),
        mlps=MLPWeights(opacity=head(k), color=head(3 * k), covariance=head(7 * k)),
        free=FreeGaussians(
            means=torch.randn(free, 3, generator=g) * 0.4,
            log_scales=torch.randn(free, 3, generator=g) * 0.2 - 2.0,
            quats=torch.randn(free, 4, generator=g),
            logit_opacities=torch.randn(free, generator=g),
            colors=torch.rand(free, 3, generator=g),
            births=births,
        ),
        camera_color=CameraColor.identity(cameras),
        distance_input=True,
    )
