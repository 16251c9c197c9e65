# SPDX-License-Identifier: Apache-2.0
"""Movers are followed through frames without an iteration, in a world whose motion is known."""

from dataclasses import replace

import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.groups import tracking
from structgstream.groups.tracking import TrackConfig, Tracked, Tracker, _measure_view, track_frame
from structgstream.training.online.config import MotionConfig
from tests.support.backends import quickest_backend
from tests.support.worlds import World, moving_world

SPEED, FRAMES = 0.06, 5
TRUTH = (FRAMES - 1) * SPEED
CONFIG = TrackConfig(cameras=8, picture_scale=0.5)


def world(*, speed: float = SPEED, movers: int = 60) -> World:
    return moving_world(FRAMES, cameras=6, movers=movers, speed=speed, width=128, height=96)


def tracker(scenery: World, config: TrackConfig = CONFIG, *, occluded_share: float = 0.0) -> Tracker:
    motion = MotionConfig(enabled=True, occluded_share=occluded_share)
    return Tracker(config, motion, scenery.rig, quickest_backend())


def tracked(
    scenery: World, config: TrackConfig = CONFIG, *, frames: int = FRAMES, occluded_share: float = 0.0
) -> Tracked:
    chosen, past = tracker(scenery, config, occluded_share=occluded_share), Tracked.at_rest(scenery.scene)
    before = chosen.pictures(scenery.frames[0], None).views
    for frame in scenery.frames[1:frames]:
        pictures = chosen.pictures(frame, before)
        before, past = pictures.views, track_frame(chosen, past, pictures)
    return past


def moved(found: Tracked, scenery: World) -> torch.Tensor:
    """How far each anchor has gone to the right."""
    return (found.scene.anchors.positions - scenery.scene.anchors.positions)[:, 0]


def test_movers_are_followed_over_many_frames() -> None:
    scenery = world()
    found = tracked(scenery)
    assert abs(float(moved(found, scenery).median()) - TRUTH) < 0.3 * TRUTH
    assert abs(float(found.velocities[:, 0].median()) - SPEED) < 0.4 * SPEED


def test_hidden_anchors_go_along_with_what_hides_them() -> None:
    scenery = world()
    start = scenery.scene.anchors.positions
    alone, carried = (tracked(scenery, occluded_share=share).scene.anchors.positions for share in (0.0, 0.4))
    left = (alone == start).all(1) & (carried != start).any(1)
    assert int(left.sum()) > 0
    assert float((carried - start)[left, 0].mean()) > 0.3 * TRUTH


def test_flow_from_the_rendering_corrects_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    scenery, errors = world(), []
    monkeypatch.setattr(tracking, "RENDERED_EVERY", 1)
    nothing = lambda tracker, scene, seen, velocities: torch.zeros_like(seen.flows)  # noqa: E731
    for flow in (tracking._rendered_flow, nothing):
        monkeypatch.setattr(tracking, "_rendered_flow", flow)
        errors.append(float((moved(tracked(scenery), scenery) - TRUTH).abs().mean()))
    assert errors[0] < errors[1]


def test_what_stands_still_keeps_its_bits() -> None:
    scenery = world(speed=0.0)
    found = tracked(scenery)
    assert torch.equal(found.scene.anchors.positions, scenery.scene.anchors.positions)
    assert not found.velocities.any()


def test_cameras_are_taken_in_turn_and_the_change_is_reported() -> None:
    scenery = world()
    chosen = tracker(scenery, replace(CONFIG, cameras=3))
    first = chosen.pictures(scenery.frames[0], None)
    assert (len(first.views), dict(first.changes), first.changed_share) == (5, {}, 0.0)
    second, third = (
        chosen.pictures(scenery.frames[t], chosen.pictures(scenery.frames[t - 1], None).views) for t in (1, 2)
    )
    assert (sorted(second.changes), sorted(third.changes)) == ([1, 3], [0, 2, 4])
    assert second.changed_share > 0.05


def test_pictures_of_the_size_of_the_stream_are_not_copied() -> None:
    scenery = world()
    frame = scenery.frames[0]
    views = tracker(scenery).pictures(frame, None).views
    assert [view.image.data_ptr() for view in views] == [
        frame.images[scenery.rig.training[view.index]].ctypes.data for view in views
    ]


@pytest.mark.parametrize(("cameras", "stride"), [(2, 1), (10, 1), (11, 2), (12, 2), (27, 2), (28, 2), (30, 3)])
def test_half_of_a_rig_is_used_in_a_frame_but_not_of_a_small_one(cameras: int, stride: int) -> None:
    assert tracker(world(), replace(CONFIG, cameras=None)).stride(cameras) == stride
    assert tracker(world(), replace(CONFIG, cameras=cameras)).stride(cameras) == 1


def test_half_of_the_cameras_in_turn_follow_what_all_do() -> None:
    scenery = world()
    every, half = (tracked(scenery, replace(CONFIG, cameras=cameras)) for cameras in (8, 3))
    errors = [float((moved(found, scenery) - TRUTH).abs().median()) for found in (every, half)]
    assert errors[1] < errors[0] + 0.3 * TRUTH


def test_a_frame_without_a_known_picture_moves_nothing() -> None:
    scenery = world()
    chosen = tracker(scenery)
    nothing = chosen.pictures(scenery.frames[1], [])
    found = track_frame(chosen, Tracked.at_rest(scenery.scene), nothing)
    assert torch.equal(found.scene.anchors.positions, scenery.scene.anchors.positions)


def test_coverage_is_in_pixels_of_the_reference_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """In pictures of twice the size movers cover as many pixels."""
    scenery = world()
    monkeypatch.setattr("structgstream.cameras.REFERENCE_PIXELS", 128)

    def coverage(times: int) -> torch.Tensor:
        rig = CameraRig(
            {name: scenery.rig[name].resized(128 * times, 96 * times) for name in scenery.rig}, scenery.rig.held_out
        )
        enlarged = World(rig, scenery.scene, [])
        chosen = tracker(enlarged)
        frames = [
            MultiViewFrame(n, 0.0, {name: i.repeat(times, 0).repeat(times, 1) for name, i in frame.images.items()})
            for n, frame in enumerate(scenery.frames[:2])
        ]
        pictures = chosen.pictures(frames[1], chosen.pictures(frames[0], None).views)
        changes = pictures.changes.items()
        measured = [_measure_view(chosen, scenery.scene, pictures.views[n], change) for n, change in changes]
        return torch.stack([entry.flows[:, 3] for entry in measured]).sum(0)

    assert 0.8 < float(coverage(2).sum() / coverage(1).sum()) < 1.25  # 4 if it were in pixels of each size.
