# SPDX-License-Identifier: Apache-2.0
"""Static content continues from group to group; what moves, or would show as a mixture, is the group's own."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from structgstream import cameras
from structgstream.cameras import CameraRig
from structgstream.codec.fields.quantization import dequantize, quantize
from structgstream.groups.base import GroupBase
from structgstream.groups.seam_blend import (
    FADE_FRAMES,
    NEIGHBOURS,
    SeamBlend,
    draw_border,
    moving_at_border,
    visible_mixtures,
)
from structgstream.kernels.values import HeadWeights
from structgstream.scene.scene import Scene
from structgstream.training.online.measure import primitive_sums, slot_count
from structgstream.training.online.patching import IDS_PER_FRAME
from tests.support.backends import quickest_backend
from tests.support.clip_groups import made
from tests.support.streams import STEPS, small_scene

SIDE = 2 * NEIGHBOURS
"""Anchors of each of two heaps far apart, so that each is a neighbourhood of its own."""
STEP, LIGHT_STEP = STEPS["anchor_positions"], STEPS["color_mlp"]
LEFT = torch.arange(2 * SIDE) < SIDE
NONE = torch.zeros(2 * SIDE, dtype=torch.bool)


def two_heaps(*, seed: int = 0, free: int = 0) -> Scene:
    """Two heaps of anchors, 100 apart, on the bins; free Gaussians alternate between the heaps."""
    scene = small_scene(2 * SIDE, seed=seed, free=free)
    positions = small_scene(2 * SIDE).anchors.positions.clone()
    positions[SIDE:, 0] += 100.0
    means = scene.free.means.clone()
    means[1::2, 0] += 100.0
    scales = on_bins(scene.anchors.log_offset_scales)
    anchors = replace(scene.anchors, positions=on_bins(positions), log_offset_scales=scales)
    return replace(scene, anchors=anchors, free=replace(scene.free, means=means))


def on_bins(values: Tensor) -> Tensor:
    return dequantize(quantize(values, STEP), STEP)


def shifted(scene: Scene, rows: Tensor, bins: int) -> Scene:
    return displaced(scene, rows, bins * STEP)


def born_in(scene: Scene, frame: int) -> Scene:
    births = frame * IDS_PER_FRAME + torch.arange(len(scene.free))
    return replace(scene, free=replace(scene.free, births=births))


def bins_from(shown: Scene, own: Scene) -> Tensor:
    """By how many bins positions of ``shown`` differ from the group's own, ``[M, 3]``."""
    return ((shown.anchors.positions - own.anchors.positions) / STEP).round()


def test_what_stands_still_has_the_bits_of_the_frame_before() -> None:
    own = two_heaps()
    before = shifted(own, ~NONE, 5)
    shown = SeamBlend(before, own, NONE, steps=STEPS).scene(own)
    assert torch.equal(shown.anchors.positions, before.anchors.positions)
    assert torch.equal(shown.anchors.log_offset_scales, before.anchors.log_offset_scales)


@pytest.mark.parametrize("bins", [1, -1, 60])
def test_differences_fade_in_equal_steps(bins: int) -> None:
    """Of differences of one bin a like number goes in each frame."""
    own = two_heaps()
    seam_blend = SeamBlend(shifted(own, ~NONE, bins), own, NONE, steps=STEPS)
    for left in range(FADE_FRAMES + 1, -1, -1):
        differences = bins_from(seam_blend.scene(own), own)
        expected = bins * left / (FADE_FRAMES + 1)
        assert torch.all((differences - expected).abs() < 1.0)
        assert abs(float(differences.mean()) - expected) < 0.05 * abs(bins)
    assert torch.equal(seam_blend.scene(own).anchors.positions, own.anchors.positions)


def in_light(scene: Scene, bins: int) -> Scene:
    """On the bins, with the output biases of F_c brighter by as many."""
    head = HeadWeights(*(dequantize(quantize(weight, LIGHT_STEP), LIGHT_STEP) for weight in scene.mlps.color))
    biases = dequantize(quantize(head.b2, LIGHT_STEP) + bins, LIGHT_STEP)
    return replace(scene, mlps=scene.mlps._replace(color=head._replace(b2=biases)))


@pytest.mark.parametrize("bins", [4, -3])
def test_light_goes_over_in_equal_steps_where_things_move_too(bins: int) -> None:
    own = in_light(two_heaps(), 0)
    before = in_light(two_heaps(), bins)
    seam_blend = SeamBlend(before, own, ~NONE, steps=STEPS)
    brighter = []
    for _ in range(FADE_FRAMES + 2):
        shown = seam_blend.scene(own)
        brighter.append(((shown.mlps.color.b2 - own.mlps.color.b2) / LIGHT_STEP).round().unique().tolist())
        assert torch.equal(shown.mlps.color.w2, own.mlps.color.w2)
        assert torch.equal(shown.anchors.positions, own.anchors.positions)
    assert brighter[0] == [bins], "the light of the frame before"
    steps = [float(later[0] - earlier[0]) for earlier, later in pairwise(brighter)]
    assert all(abs(step) <= 1.0 and step * bins <= 0.0 for step in steps)
    assert brighter[-1] == [0.0]


def test_what_moves_at_the_border_is_the_groups_own() -> None:
    own = two_heaps()
    before = shifted(own, ~NONE, 5)
    shown = SeamBlend(before, own, LEFT, steps=STEPS).scene(own)
    assert torch.equal(shown.anchors.positions[LEFT], own.anchors.positions[LEFT])
    assert torch.equal(shown.anchors.positions[~LEFT], before.anchors.positions[~LEFT])


def test_what_is_withdrawn_is_the_groups_own() -> None:
    own = two_heaps()
    before = shifted(own, ~NONE, 5)
    seam_blend = SeamBlend(before, own, NONE, steps=STEPS)
    one = torch.arange(2 * SIDE) == 2 * SIDE - 1
    assert (seam_blend.blended, seam_blend.withdraw(LEFT), seam_blend.withdraw(LEFT), seam_blend.withdraw(one)) == (
        2 * SIDE,
        SIDE,
        0,
        1,
    )
    expected = torch.where((LEFT | one)[:, None], own.anchors.positions, before.anchors.positions)
    assert torch.equal(seam_blend.first.anchors.positions, expected)
    assert torch.equal(seam_blend.scene(own).anchors.positions, expected)
    assert seam_blend.blended == SIDE - 1


def test_an_anchor_between_those_withdrawn_is_withdrawn() -> None:
    own = two_heaps()
    seam_blend = SeamBlend(shifted(own, ~NONE, 5), own, NONE, steps=STEPS)
    some = LEFT & (torch.arange(2 * SIDE) % 2 == 0)
    assert SIDE // 2 < seam_blend.withdraw(some) <= SIDE


def test_differences_halve_besides_where_the_group_moves() -> None:
    own = two_heaps()
    seam_blend = SeamBlend(shifted(own, ~NONE, -48), own, NONE, steps=STEPS)
    seam_blend.scene(own)
    for halved, left in ((24, 5), (12, 4), (6, 3)):
        own = shifted(own, LEFT, 1)
        differences = bins_from(seam_blend.scene(own), own)
        share = left / (FADE_FRAMES + 1)
        assert ((differences[LEFT] + halved * share).abs() < 1.0).all()
        assert torch.equal(differences[~LEFT], torch.full_like(differences[~LEFT], -48 * share))


def test_a_few_movers_keep_their_neighbourhood_and_fade_themselves() -> None:
    own = two_heaps()
    seam_blend = SeamBlend(shifted(own, ~NONE, 24), own, NONE, steps=STEPS)
    seam_blend.scene(own)
    one = torch.arange(2 * SIDE) == 3
    moved = shifted(own, one, 1)
    differences = bins_from(seam_blend.scene(moved), moved)
    share = FADE_FRAMES / (FADE_FRAMES + 1)
    assert (differences[one] == 12 * share).all()
    assert (differences[~one] == 24 * share).all()


@pytest.mark.parametrize("moving", [NONE, ~NONE], ids=["still", "moving"])
def test_free_gaussians_are_the_groups_own_at_once(moving: Tensor) -> None:
    before, own = born_in(two_heaps(free=4), 2), born_in(two_heaps(free=6), 8)
    shown = SeamBlend(before, own, moving, steps=STEPS).scene(own)
    assert torch.equal(shown.free.births, own.free.births)
    assert torch.equal(shown.free.means, own.free.means)


def most_seen(scene: Scene, rig: CameraRig) -> int:
    """The anchor that covers most of the pictures."""
    backend, cameras = quickest_backend(), [rig[name] for name in rig.training]
    viewports = [camera.viewport(scene.anchors.positions) for camera in cameras]
    maps = torch.ones(len(cameras), cameras[0].height, cameras[0].width, 1)
    gaussians = scene.gaussians_of_views(cameras, backend)
    sums = backend.weigh_views(gaussians, viewports, maps, slots=slot_count(scene))
    return int(primitive_sums(sums.sum(0), scene)[: len(scene.anchors)].argmax())


def moving(before: Scene, first: Scene, rig: CameraRig, **around: Scene) -> Tensor | None:
    backend = quickest_backend()
    return moving_at_border(before, first, draw_border(before, first, rig, backend), rig, backend, **around)


def test_what_moved_is_found_and_what_did_not_is_not(base: tuple[Scene, CameraRig]) -> None:
    first, rig = base
    at = first.anchors.positions
    center = at[most_seen(first, rig)]
    there = (at - center).norm(dim=1) < (at - center).norm(dim=1).quantile(0.1)
    before = displaced(first, there)
    found = moving(first, first, rig)
    assert not found.any()
    found = moving(before, first, rig)
    # Pictures of 80x60 show few of the anchors in a heap.
    assert found[there].float().mean() > 3.0 * found[~there].float().mean()
    slowly = displaced(first, there, 1e-4)
    for around in ({"second": slowly}, {"earlier": slowly}):
        found = moving(first, first, rig, **around)
        assert torch.equal(found, there)


def test_at_a_cut_nothing_is_handed_over(base: tuple[Scene, CameraRig]) -> None:
    first, rig = base
    gone = replace(first, anchors=replace(first.anchors, positions=first.anchors.positions + 50.0))
    assert moving(gone, first, rig, second=first) is None


@pytest.fixture(scope="module")
def base() -> tuple[Scene, CameraRig]:
    found = GroupBase.read(made().header)
    return found.scene(), found.header.similarity.rig(found.header.rig)


def middle(scene: Scene) -> Tensor:
    """The tenth of the anchors that is nearest to their centre."""
    apart = (scene.anchors.positions - scene.anchors.positions.median(0).values).norm(dim=1)
    return apart < apart.quantile(0.1)


def displaced(scene: Scene, rows: Tensor, by: float = 0.3) -> Scene:
    positions = scene.anchors.positions + by * rows[:, None]
    return replace(scene, anchors=replace(scene.anchors, positions=positions))


def test_what_either_frame_shows_is_no_mixture(base: tuple[Scene, CameraRig]) -> None:
    scene, rig = base
    backend = quickest_backend()
    assert not visible_mixtures(scene, draw_border(scene, scene, rig, backend), rig, backend).any()
    other = displaced(scene, middle(scene))
    assert not visible_mixtures(scene, draw_border(other, scene, rig, backend), rig, backend).any()


def test_what_neither_frame_shows_is_found_where_it_is(base: tuple[Scene, CameraRig]) -> None:
    scene, rig = base
    there = middle(scene)
    backend = quickest_backend()
    found = visible_mixtures(displaced(scene, there), draw_border(scene, scene, rig, backend), rig, backend)
    assert found[there].float().mean() > 2.0 * found[~there].float().mean() > 0.0


def test_what_shows_is_the_same_in_larger_pictures(
    base: tuple[Scene, CameraRig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Coverage is measured at one size, so that specks count in large pictures as they do in small ones."""
    scene, rig = base
    there, backend = middle(scene), quickest_backend()
    sides = max(max(rig[name].width, rig[name].height) for name in rig)
    large = replace(rig, cameras={name: rig[name].resized(2 * rig[name].width, 2 * rig[name].height) for name in rig})
    monkeypatch.setattr(cameras, "REFERENCE_PIXELS", sides)
    found = [
        visible_mixtures(displaced(scene, there), draw_border(scene, scene, of, backend), of, backend)
        for of in (rig, large)
    ]
    other = (found[0] != found[1]).float().mean() / found[0].float().mean()
    assert float(other) < 0.3  # 0.62 if coverage is in pixels of each size.
