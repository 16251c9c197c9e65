# SPDX-License-Identifier: Apache-2.0
import torch

from rigs import arc_rig, random_scene
from structgstream.kernels.backend import reference_backend
from structgstream.scene.anchors import visible_anchors
from structgstream.scene.render import draw


def test_culling_never_changes_a_pixel() -> None:
    scene, backend = random_scene(300, seed=3), reference_backend()
    for camera in list(arc_rig(radius=0.6).cameras.values()):
        visible = visible_anchors(scene.anchors, camera)
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


def test_anchors_behind_the_camera_are_culled() -> None:
    scene = random_scene(10)
    camera = arc_rig()["cam01"]
    behind = scene.anchors.positions + 20.0 * (camera.center - torch.zeros(3)).float()
    moved = type(scene.anchors)(**{**vars(scene.anchors), "positions": behind})
    assert visible_anchors(moved, camera).numel() == 0
