# SPDX-License-Identifier: Apache-2.0
"""Views whose pictures disagree with what the others say are left out."""

from dataclasses import replace

import torch

from structgstream.training.online.config import MotionConfig
from structgstream.training.online.measure import ViewChange
from structgstream.training.online.select import inlier_views, is_scene_cut, outlier_candidates, unrecognized_faults
from tests.support.varied import varied
from tests.support.worlds import moved_since, moving_world

USUAL = ViewChange(changed_share=0.05, wrong_share=0.02, repeated=False)
WORLD = moving_world(2, speed=0.06, movers=10, cameras=7)
CONFIG = varied(MotionConfig(enabled=True, picture_scale=1.0), REACH_PIXELS=1)


def wrong(*shares: float) -> list[ViewChange]:
    """Usual pictures with these shares of wrong pixels."""
    return [replace(USUAL, wrong_share=share) for share in shares]


def test_usual_pictures_are_believed() -> None:
    assert inlier_views([USUAL] * 5) == [True] * 5
    assert not is_scene_cut([USUAL] * 5)


def test_a_picture_that_changed_or_is_wrong_everywhere_is_not() -> None:
    for odd in (replace(USUAL, changed_share=0.9), replace(USUAL, wrong_share=0.9)):
        assert inlier_views([USUAL, odd, USUAL, USUAL]) == [True, False, True, True]


def test_a_bumped_camera_is_wrong_where_it_shows_something() -> None:
    """The shares of a camera of counter that was moved by 14 and 9 pixels, and of the others."""
    assert inlier_views(wrong(0.005, 0.008, 0.016, 0.43)) == [True, True, True, False]


def test_a_camera_near_to_what_moves_is_believed() -> None:
    """The shares of basketball's throw, and of someone who comes near one camera while others are wrong, too."""
    throw = [replace(view, changed_share=0.1) for view in wrong(0.016, 0.034, 0.034, 0.088)]
    assert all(inlier_views(throw))
    assert all(inlier_views([*throw, *wrong(0.25)]))
    assert all(inlier_views(wrong(0.001, 0.001, 0.001, 0.19)))


def test_a_shifted_picture_is_a_bumped_camera_however_little_of_it_is_wrong() -> None:
    """The shares of a camera of basketball that was moved by 14 and 9 pixels, before a plain wall, and of others."""
    views = wrong(0.005, 0.004, 0.014, 0.018, 0.176)
    assert all(inlier_views(views))
    assert outlier_candidates(views) == [4]
    assert inlier_views([*views[:4], replace(views[4], shift_pixels=16.0)]) == [True, True, True, True, False]
    assert all(inlier_views([*views[:4], replace(views[4], shift_pixels=1.5)])), "someone comes near that camera"
    assert outlier_candidates([replace(view, wrong_share=0.1 * view.wrong_share) for view in views]) == []


def test_a_frozen_picture_is_not_while_others_change() -> None:
    frozen = ViewChange(changed_share=0.0, wrong_share=0.0, repeated=True)
    assert inlier_views([USUAL, USUAL, USUAL, frozen]) == [True, True, True, False]
    assert inlier_views([frozen] * 3) == [True] * 3, "nothing moves: all are equal to the last"


def test_when_all_change_everywhere_it_is_a_jump_and_all_are_believed() -> None:
    everywhere = [replace(USUAL, changed_share=0.95)] * 4
    assert is_scene_cut(everywhere)
    assert all(inlier_views(everywhere))


def test_two_views_are_always_left() -> None:
    assert inlier_views([USUAL, replace(USUAL, changed_share=0.9)]) == [True, True]


def test_what_few_views_cannot_show_is_said() -> None:
    """The sentences are what :func:`inlier_views` does."""
    frozen = ViewChange(changed_share=0.0, wrong_share=0.02, repeated=True)
    bumped = replace(USUAL, shift_pixels=9.0)
    for views in range(2, 6):
        found = {
            name: not inlier_views([odd, *[USUAL] * (views - 1)])[0]
            for name, odd in (("frozen", frozen), ("bumped", bumped), ("fails", *wrong(0.9)))
        }
        said = unrecognized_faults(views) or ""
        assert found == {name: name not in said for name in found}, views
    said = "With 3 training cameras one that is frozen cannot be recognised; that takes 4 or more."
    assert unrecognized_faults(3) == said


def test_a_black_picture_moves_nothing() -> None:
    before, views = (WORLD.views(t) for t in (0, 1))
    spoiled = [replace(v, image=torch.zeros_like(v.image)) if n in (1, 3) else v for n, v in enumerate(views)]
    good = [n for n in range(len(views)) if n not in (1, 3)]
    found = moved_since(WORLD.scene, spoiled, before, config=CONFIG)
    without = moved_since(WORLD.scene, [views[n] for n in good], [before[n] for n in good], config=CONFIG)
    assert found.inliers == tuple(good)
    assert torch.equal(found.anchors, without.anchors)
    assert found.anchors.any()


def test_a_light_switched_on_is_a_jump() -> None:
    before, views = (WORLD.views(t) for t in (0, 1))
    bright = [replace(v, image=(v.image.int() + 60).clamp(max=255).to(torch.uint8)) for v in views]
    found = moved_since(WORLD.scene, bright, before, config=CONFIG, flow_from=range(len(views)))
    assert found.scene_cut
    assert found.evidence is None
    assert len(found.inliers) == len(views)


def test_a_view_that_was_absent_before_is_trusted_and_no_measure_for_others() -> None:
    back = ViewChange(changed_share=None, wrong_share=0.0, repeated=False)
    odd = replace(USUAL, changed_share=0.9)
    assert inlier_views([USUAL, back, odd, USUAL, back]) == [True, True, False, True, True]
    assert is_scene_cut([odd, odd, back, back, back])
    assert not is_scene_cut([USUAL, back])
