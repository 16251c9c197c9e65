# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import torch

from structgstream.kernels.backend import reference_backend
from structgstream.kernels.reference_anchors import activate_anchors
from structgstream.kernels.values import Anchors, TileSelection, tile_grid
from structgstream.scene.render import draw
from tests.support.rigs import arc_rig, random_scene


def test_culling_never_changes_a_pixel() -> None:
    scene, backend = random_scene(300, seed=3), reference_backend()
    for camera in list(arc_rig(radius=0.6).cameras.values()):
        assert 0 < len(scene.structured(camera, backend).anchors) < 300
        cloud = scene.anchors
        anchors = Anchors(
            cloud.positions, cloud.log_offset_scales, cloud.log_base_scales, cloud.offsets, cloud.features
        )
        everything = activate_anchors(
            anchors, scene.mlps, camera.center.float(), torch.arange(300), distance_input=True
        )
        culled = draw(scene.gaussians(camera, backend), camera, backend)
        full = draw(scene.with_free_gaussians(everything), camera, backend)
        assert torch.allclose(culled.image, full.image, atol=1e-6)


def test_culling_for_tiles_never_changes_a_pixel_in_them() -> None:
    scene, backend = random_scene(300, seed=3), reference_backend()
    for camera in list(arc_rig(radius=0.6).cameras.values()):
        mask = torch.zeros(tile_grid(camera.width, camera.height), dtype=torch.bool)
        mask[-1, 1] = True
        tiles = TileSelection(mask, camera.width, camera.height)
        culled = scene.structured(camera, backend, tiles=tiles)
        assert len(culled.anchors) < len(scene.structured(camera, backend).anchors)
        inside = tiles.pixels()
        part = draw(scene.with_free_gaussians(culled), camera, backend).image[inside]
        assert torch.allclose(part, draw(scene.gaussians(camera, backend), camera, backend).image[inside], atol=1e-6)


def test_anchors_behind_the_camera_are_culled() -> None:
    scene = random_scene(10)
    camera = arc_rig()["cam01"]
    behind = scene.anchors.positions + 20.0 * (camera.center - torch.zeros(3)).float()
    moved = replace(scene.anchors, positions=behind)
    scene = replace(scene, anchors=moved)
    assert scene.structured(camera, reference_backend()).anchors.numel() == 0


def test_anchors_are_appended_with_every_column_that_they_have() -> None:
    cloud = replace(random_scene(5).anchors, appearance=torch.rand(5, 3))
    both = cloud.select(torch.arange(2)).append(cloud.select(torch.arange(2, 5)))
    for name in ("positions", "log_offset_scales", "log_base_scales", "offsets", "features", "appearance"):
        assert torch.equal(getattr(both, name), getattr(cloud, name)), name
