# SPDX-License-Identifier: Apache-2.0
"""Static content continues from group to group, exactly, for as long as it is static."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from structgstream.codec.fields.quantization import dequantize, quantize
from structgstream.groups.seam_blend import FADE_FRAMES, NEIGHBOURS, SeamBlend
from structgstream.kernels.values import HeadWeights
from structgstream.scene.scene import Scene
from structgstream.training.online.patching import IDS_PER_FRAME
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
    positions = scene.anchors.positions + bins * STEP * rows[:, None]
    return replace(scene, anchors=replace(scene.anchors, positions=positions))


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
