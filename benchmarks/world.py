# SPDX-License-Identifier: Apache-2.0
"""A wall of textured anchors, of which a rectangle moves between two frames; the pictures are its own renderings.

The true scene of both frames is known, so a fit can be started from frame 0 exactly and be judged on frame 1 at a
camera that training does not see. The wall's size is fixed: more anchors are a finer texture, not a larger picture.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from structgstream.cameras import Camera, CameraRig
from structgstream.evaluation.camera_path import look_at
from structgstream.evaluation.metrics import psnr
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import HeadWeights, MLPWeights
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.render import render_picture
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device
from structgstream.training.online.config import OnlineConfig
from structgstream.training.online.fit import fit_next_frame
from structgstream.training.online.preprocess import preprocess
from structgstream.training.result import FitResult
from structgstream.training.views import training_views

WALL_WIDTH, WALL_HEIGHT = 2.8, 2.1
DISTANCE = 2.4
FOCAL = 0.83  # Of a picture's width.
OFFSETS_PER_ANCHOR = 5
FEATURES = 32
HIDDEN = 32
HELD_OUT = "held_out"


@dataclass(frozen=True)
class World:
    """Two instants of one wall.

    Args:
        rig: the cameras, one of them held out; in normalised units.
        before: the true scene of frame 0.
        previous: the pictures of frame 0.
        frame: the pictures of frame 1, in which part of the wall has moved.
    """

    rig: CameraRig
    before: Scene
    previous: MultiViewFrame
    frame: MultiViewFrame


def wall_scene(anchors: int, *, cameras: int, seed: int = 2) -> Scene:
    """``anchors`` anchors on a slightly wavy wall at z = 0; about half of their Gaussians are drawn."""
    g = torch.Generator().manual_seed(seed)
    # What is shared by all anchors comes first, so that it is the same for every number of them.
    mlps = MLPWeights(*(_head(width * OFFSETS_PER_ANCHOR, g) for width in (1, 3, 7)))
    waves = torch.randn(2, FEATURES, generator=g) * 4.0
    columns = max(1, round((anchors * WALL_WIDTH / WALL_HEIGHT) ** 0.5))
    spacing = WALL_WIDTH / columns
    index = torch.arange(anchors)
    rows = (anchors + columns - 1) // columns
    x = (index % columns + torch.rand(anchors, generator=g)) * spacing - WALL_WIDTH / 2
    y = (index // columns + torch.rand(anchors, generator=g)) * (WALL_HEIGHT / rows) - WALL_HEIGHT / 2
    z = 0.1 * torch.sin(4.0 * x) * torch.cos(3.0 * y) + 0.02 * torch.rand(anchors, generator=g)
    # Features mix waves of the place with noise, so that the texture has coarse and fine detail.
    features = torch.sin(torch.stack([x, y], dim=1) @ waves) + 0.7 * torch.randn(anchors, FEATURES, generator=g)
    log_spacing = float(np.log(spacing))
    return Scene(
        anchors=AnchorCloud(
            positions=torch.stack([x, y, z], dim=1),
            log_offset_scales=torch.full((anchors, 3), log_spacing),
            log_base_scales=torch.full((anchors, 3), log_spacing) + 0.2 * torch.randn(anchors, 3, generator=g),
            offsets=0.5 * torch.randn(anchors, OFFSETS_PER_ANCHOR, 3, generator=g),
            features=features,
        ),
        mlps=mlps,
        free=FreeGaussians.empty(),
        camera_color=CameraColor.identity(cameras),
        distance_input=True,
    )


def _head(outputs: int, g: torch.Generator) -> HeadWeights:
    return HeadWeights(
        torch.randn(HIDDEN, FEATURES + 4, generator=g) * 0.25,
        torch.randn(HIDDEN, generator=g) * 0.1,
        torch.randn(outputs, HIDDEN, generator=g) * 0.25,
        torch.randn(outputs, generator=g) * 0.1,
    )


def wall_rig(cameras: int, *, width: int, height: int) -> CameraRig:
    """``cameras`` training cameras on an arc before the wall and one held-out camera between them."""
    names = {f"cam{i:02d}": 2.0 * i / max(cameras - 1, 1) - 1.0 for i in range(cameras)} | {HELD_OUT: 0.1}
    found = {}
    for i, (name, place) in enumerate(names.items()):
        angle = torch.tensor(0.42 * place, dtype=torch.float64)
        up = torch.tensor(0.0 if name == HELD_OUT else 0.15 * (i % 3 - 1), dtype=torch.float64)
        eye = torch.stack([DISTANCE * angle.sin(), up, -DISTANCE * angle.cos()])
        focal = FOCAL * width
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
        viewmat = look_at(eye, torch.zeros_like(eye), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
        found[name] = Camera(viewmat, K, width, height, near=0.1)
    return CameraRig(found, held_out=frozenset({HELD_OUT}))


def moved(scene: Scene, *, share: float, shift: tuple[float, float, float]) -> Scene:
    """The wall after a rectangle in its middle, ``share`` (0 to 1) of its area, has shifted."""
    positions = scene.anchors.positions
    inside = (positions[:, 0].abs() <= share**0.5 * WALL_WIDTH / 2) & (
        positions[:, 1].abs() <= share**0.5 * WALL_HEIGHT / 2
    )
    shifted = positions + inside[:, None] * torch.tensor(shift)
    return replace(scene, anchors=replace(scene.anchors, positions=shifted))


def wall_world(
    backend: Backend,
    *,
    anchors: int,
    width: int,
    height: int,
    cameras: int,
    share: float = 1.0,
    shift_pixels: float = 2.0,
    noise: float = 0.0,
    seed: int = 2,
) -> World:
    """The wall before and after ``share`` of its area has moved by about ``shift_pixels`` in the pictures, sideways.

    ``noise`` is the standard deviation, in levels of 255, of what the training cameras' sensors add to each picture.
    """
    rig = wall_rig(cameras, width=width, height=height)
    before = wall_scene(anchors, cameras=cameras, seed=seed)
    after = moved(before, share=share, shift=(shift_pixels * DISTANCE / (FOCAL * width), 0.0, 0.0))
    g = np.random.default_rng(seed)

    def taken(scene: Scene, index: int) -> MultiViewFrame:
        images = {name: render_picture(scene, rig[name], backend) for name in rig}
        for name in rig.training if noise else ():
            grain = noise * g.standard_normal(images[name].shape, dtype=np.float32)
            images[name] = (images[name] + grain).round().clip(0, 255).astype(np.uint8)
        return MultiViewFrame(index, index / 30.0, images)

    return World(rig, before, taken(before, 0), taken(after, 1))


def fitted(world: World, backend: Backend, config: OnlineConfig) -> FitResult:
    """Frame 1 fitted from the true scene of frame 0; its pictures are prepared by the caller's thread."""
    pictures = preprocess(
        world.frame,
        world.rig,
        before=training_views(world.previous, world.rig, backend.device),
        motion=config.motion,
        scene_flow=config.scene_flow,
        backend=backend,
    )
    scene = on_device(world.before, backend.device)
    return fit_next_frame(scene, world.frame, world.rig, config=config, backend=backend, seed=0, pictures=pictures)


def held_out_psnr(scene: Scene, world: World, backend: Backend) -> float:
    """PSNR of ``scene`` against frame 1 at the held-out camera, dB."""
    return psnr(render_picture(scene, world.rig[HELD_OUT], backend), world.frame.images[HELD_OUT])
