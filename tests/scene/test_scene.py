# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import torch

from structgstream.kernels.backend import reference_backend
from structgstream.scene.color import CameraColor
from tests.support.rigs import arc_rig, random_scene


def test_ids_name_the_slot_of_each_gaussian() -> None:
    scene, camera = random_scene(20, free=3), arc_rig()["cam01"]
    gaussians = scene.gaussians(camera, reference_backend())
    structured = gaussians.ids < 20 * 5
    anchor, offset = gaussians.ids[structured] // 5, gaussians.ids[structured] % 5
    # The paper's equation for structured positions: mu = x_v + O * l_v.
    expected = scene.anchors.positions[anchor] + scene.anchors.offsets[anchor, offset] * (
        scene.anchors.log_offset_scales[anchor].exp()
    )
    assert torch.allclose(gaussians.means[structured], expected, atol=1e-6)
    assert gaussians.ids[~structured].tolist() == [100, 101, 102]
    assert torch.equal(gaussians.means[~structured], scene.free.means)


def test_only_positive_opacities_are_drawn() -> None:
    gaussians = random_scene(50).gaussians(arc_rig()["cam01"], reference_backend())
    assert 0 < len(gaussians) < 250
    assert (gaussians.opacities > 0).all()


def test_attributes_depend_on_the_view_and_positions_do_not() -> None:
    scene, rig, backend = random_scene(30), arc_rig(), reference_backend()
    one, two = (scene.gaussians(rig[name], backend) for name in ("cam01", "cam03"))
    shared = one.ids[torch.isin(one.ids, two.ids)]
    a, b = torch.searchsorted(one.ids, shared), torch.searchsorted(two.ids, shared)
    assert torch.equal(one.means[a], two.means[b])
    assert not torch.allclose(one.colors[a], two.colors[b])


def test_without_the_distance_input_the_distance_does_not_matter() -> None:
    scene = random_scene(10)
    narrow = replace(
        scene,
        distance_input=False,
        mlps=type(scene.mlps)(*(head._replace(w1=head.w1[:, :-1].contiguous()) for head in scene.mlps)),
    )
    camera = arc_rig()["cam01"]
    assert len(narrow.gaussians(camera, reference_backend())) > 0


def test_the_gauge_is_exact_and_keeps_differences() -> None:
    color = CameraColor(gains=torch.rand(5, 3) + 0.5, biases=torch.rand(5, 3) - 0.5)
    gauged = color.gauged()
    assert torch.allclose(gauged.gains.mean(0), torch.ones(3))
    assert torch.allclose(gauged.biases.mean(0), torch.zeros(3), atol=1e-6)
    assert torch.allclose(gauged.gains[1] - gauged.gains[0], color.gains[1] - color.gains[0])


def test_rows_keep_their_identity() -> None:
    free = random_scene(free=5).free
    kept = free.select(torch.tensor([True, False, True, False, True]))
    assert kept.births.tolist() == [0, 2, 4]
    assert torch.equal(kept.means, free.means[::2])
    both = kept.append(free)
    assert len(both) == 8
    assert both.births.tolist() == [0, 2, 4, 0, 1, 2, 3, 4]
