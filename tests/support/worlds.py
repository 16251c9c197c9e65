# SPDX-License-Identifier: Apache-2.0
"""A small world whose pictures are renderings of a known scene, so that every motion in it is known."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels.backend import Backend
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.measure import measure
from structgstream.training.online.preprocess import detect_changes
from structgstream.training.online.select import DynamicSelection, select_dynamic
from structgstream.training.residuals import BaselineResidual
from structgstream.training.views import View, training_views
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, random_scene


@dataclass(frozen=True)
class World:
    """Frames, the rig that took them, and the scene that was drawn in frame 0."""

    rig: CameraRig
    scene: Scene
    frames: list[MultiViewFrame]

    def views(self, frame: int = 0) -> list[View]:
        """The training views of a frame, on the processor."""
        return training_views(self.frames[frame], self.rig, torch.device("cpu"))

    def psnr(self, scene: Scene, frame: int = 0) -> float:
        """That of ``scene`` as the held-out camera ``cam00`` sees it, dB."""
        return psnr(rendered(scene, self, "cam00"), self.frames[frame].images["cam00"])


def emerging_ball(opacity: float) -> Gaussians:
    """A bright ball in the middle of the world."""
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, -0.6]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.12),
        opacities=torch.tensor([opacity]),
        colors=torch.tensor([[1.0, 0.1, 0.9]]),
        ids=torch.tensor([10**6]),
    )


@cache
def moving_world(
    frames: int = 3,
    *,
    cameras: int = 5,
    emerges_at: int | None = None,
    speed: float = 0.03,
    movers: int = 60,
    width: int = 48,
    height: int = 32,
) -> World:
    """The first ``movers`` of 60 anchors drift to the right; from frame ``emerges_at`` on a ball is there too.

    Drawn once a process; nobody changes it.
    """
    rig = arc_rig(cameras, width=width, height=height)
    scene = random_scene(60, cameras=cameras - 1, seed=4)
    backend = quickest_backend()
    shift = torch.zeros(60, 3)
    shift[:movers, 0] = speed
    pictures = []
    for t in range(frames):
        moved = replace(scene, anchors=replace(scene.anchors, positions=scene.anchors.positions + t * shift))
        images = {}
        for name in rig:
            gaussians = moved.gaussians(rig[name], backend)
            if emerges_at is not None and t >= emerges_at:
                gaussians = concatenate(gaussians, emerging_ball(0.95))
            image = draw(gaussians, rig[name], backend).image.detach()
            images[name] = (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        pictures.append(MultiViewFrame(t, t / 30.0, images))
    return World(rig, scene, pictures)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two uint8 pictures, dB."""
    return float(-10 * np.log10(np.mean((a.astype(float) - b.astype(float)) ** 2) / 255**2))


def rendered(scene: Scene, world: World, name: str) -> np.ndarray:
    """``scene`` as camera ``name`` of the world sees it, uint8."""
    backend = quickest_backend()
    image = draw(scene.gaussians(world.rig[name], backend), world.rig[name], backend).image.detach()
    return (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def moved_since(
    scene: Scene,
    views: Sequence[View],
    before: Sequence[View],
    *,
    config: MotionConfig,
    backend: Backend | None = None,
    flow_from: Collection[int] = (),
    before_previous: Scene | None = None,
    baseline: BaselineResidual | None = None,
) -> DynamicSelection:
    """What may move in ``scene`` between the pictures ``before`` and those of ``views``."""
    backend = backend or quickest_backend()
    changes = detect_changes(views, before, config=config, backend=backend, flow_from=flow_from)
    measured = measure(scene, views, changes, config=config, backend=backend, baseline=baseline)
    return select_dynamic(scene, measured, config=config, backend=backend, before_previous=before_previous)
