# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import torch

from rigs import arc_rig, random_scene
from structgstream.kernels.backend import reference_backend
from structgstream.kernels.raster_types import pixels_of_tiles, tiles_of
from structgstream.scene.render import draw


def test_culling_never_changes_a_pixel() -> None:
    scene, backend = random_scene(300, seed=3), reference_backend()
    for camera in list(arc_rig(radius=0.6).cameras.values()):
        _, visible = scene.structured(camera, backend)
        assert 0 < len(visible) < 300
        everything = backend.generate_structured(
            scene.anchors.positions,
            scene.anchors.log_offset_scales,
            scene.anchors.log_base_scales,
            scene.anchors.offsets,
            scene.anchors.features,
            scene.mlps,
            camera.center.float(),
            torch.arange(300),
            distance_input=True,
        )
        culled = draw(scene.gaussians(camera, backend), camera, backend)
        full = draw(scene.dressed(everything), camera, backend)
        assert torch.allclose(culled.image, full.image, atol=1e-6)


def test_culling_for_tiles_never_changes_a_pixel_in_them() -> None:
    scene, backend = random_scene(300, seed=3), reference_backend()
    for camera in list(arc_rig(radius=0.6).cameras.values()):
        tiles = torch.zeros(tiles_of(camera.width, camera.height), dtype=torch.bool)
        tiles[-1, 1] = True
        culled, visible = scene.structured(camera, backend, tiles=tiles)
        assert len(visible) < len(scene.structured(camera, backend)[1])
        inside = pixels_of_tiles(tiles, camera.width, camera.height)
        part = draw(scene.dressed(culled), camera, backend).image[inside]
        assert torch.allclose(part, draw(scene.gaussians(camera, backend), camera, backend).image[inside], atol=1e-6)


def test_anchors_behind_the_camera_are_culled() -> None:
    scene = random_scene(10)
    camera = arc_rig()["cam01"]
    behind = scene.anchors.positions + 20.0 * (camera.center - torch.zeros(3)).float()
    moved = replace(scene.anchors, positions=behind)
    scene = replace(scene, anchors=moved)
    assert scene.structured(camera, reference_backend())[1].numel() == 0
