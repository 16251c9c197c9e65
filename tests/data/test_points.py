# SPDX-License-Identifier: Apache-2.0
"""Initial points of the bundled clip, whose geometry is known: a room of about three metres around a table."""

import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pytest

from structgstream import cameras
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.matching import inside, project
from structgstream.data.plane_sweep import DEFAULT_LEVELS, SweepConfig
from structgstream.data.points import PointsConfig, _has_neighbors, initial_points
from structgstream.data.source import resized
from structgstream.frames import MultiViewFrame
from structgstream.geometry import Floats
from tests.support.planes import distance_to_surface, room_frame, room_rig
from tests.support.varied import varied


class Guarded(Mapping[str, np.ndarray]):
    """Pictures that refuse to be read for held-out cameras."""

    def __init__(self, images: Mapping[str, np.ndarray], held_out: frozenset[str]) -> None:
        self.images, self.held_out = images, held_out

    def __getitem__(self, name: str) -> np.ndarray:
        assert name not in self.held_out, f"{name} is held out"
        return self.images[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.images)

    def __len__(self) -> int:
        return len(self.images)


CLIP = resized(bundled_clip(), 0.5)
COARSE = (SweepConfig(width=80, planes=(16, 32), level_planes=True),)


def test_points_have_one_colour_in_a_training_and_the_held_out_camera() -> None:
    """A point in the wrong place projects onto something else; the held-out camera took no part in finding it."""
    frame = next(iter(CLIP.frames()))
    guarded = MultiViewFrame(0, 0.0, Guarded(frame.images, CLIP.rig.held_out))
    points = initial_points(guarded, CLIP.rig, config=PointsConfig(max_points=20_000))
    assert 5_000 < len(points) <= 20_000
    assert np.isfinite(points).all()
    cameras = [CLIP.rig[name] for name in ("cam00", "cam03")]
    projected = [project(camera, points) for camera in cameras]
    seen = np.all([inside(camera, *own, near=0.0) for camera, own in zip(cameras, projected, strict=True)], axis=0)
    assert seen.mean() > 0.4
    (columns, rows), (theirs, lines) = (pixels[seen].astype(int).T for pixels, _ in projected)

    def difference(shift: int) -> float:
        here = frame.images["cam00"][rows, (columns + shift) % cameras[0].width].astype(float)
        return float(np.median(np.abs(here - frame.images["cam03"][lines, theirs]).mean(1)))

    assert difference(0) < 20.0
    assert difference(0) < 0.5 * difference(13)


def test_pictures_without_texture_give_random_points_and_say_so(caplog: pytest.LogCaptureFixture) -> None:
    blank = MultiViewFrame(0, 0.0, {name: np.full((120, 160, 3), 128, dtype=np.uint8) for name in CLIP.rig})
    config = varied(PointsConfig(), RANDOM_POINTS=500, SWEEP_LEVELS=COARSE)
    with caplog.at_level(logging.WARNING):
        points = initial_points(blank, CLIP.rig, config=config, seed=3)
    assert 500 <= len(points) < 600  # A whole number for each camera.
    assert "random points" in caplog.text
    again = initial_points(blank, CLIP.rig, config=config, seed=3)
    other = initial_points(blank, CLIP.rig, config=config, seed=4)
    assert np.array_equal(points, again)
    assert not np.array_equal(points, other)


def room_points(*, seed: int = 0, max_points: int = 60_000, levels: tuple[SweepConfig, ...] = DEFAULT_LEVELS) -> Floats:
    rig = room_rig()
    frame = room_frame(rig)
    guarded = MultiViewFrame(0, 0.0, Guarded(frame.images, rig.held_out))
    config = varied(PointsConfig(max_points=max_points), SWEEP_LEVELS=levels)
    return initial_points(guarded, rig, config=config, seed=seed)


def test_points_lie_on_the_surfaces_of_a_room_of_planes() -> None:
    off = distance_to_surface(room_points())
    assert len(off) > 5_000
    assert np.median(off) < 0.01
    assert (off < 0.05).mean() > 0.9


def test_keypoints_alone_are_few_and_precise() -> None:
    off = distance_to_surface(room_points(levels=()))
    assert 300 < len(off) < 5_000
    assert np.median(off) < 0.01
    assert (off < 0.1).mean() > 0.97


def test_a_point_without_company_is_left_out() -> None:
    """Three others in the cells around it; where cells are so small that none has them, all found points go."""
    together, few, alone = np.zeros((4, 3)), np.full((3, 3), 5.0), np.full((1, 3), 9.0)
    beside = np.full((1, 3), 0.9)
    kept = _has_neighbors(np.concatenate([together, few, alone, beside]), cell=1.0)
    assert kept.tolist() == [True] * 4 + [False] * 4 + [True]
    rig = room_rig()
    config = varied(PointsConfig(), SWEEP_LEVELS=(), ISOLATION_SHARE=1e-6, RANDOM_POINTS=400)
    assert 400 <= len(initial_points(room_frame(rig), rig, config=config)) < 410  # random ones


def test_points_are_the_same_again_and_thinned_to_the_bound() -> None:
    points, again = (room_points(levels=COARSE, seed=seed) for seed in (0, 1))
    assert np.array_equal(points, again)  # The seed only matters to random points.
    few = room_points(levels=COARSE, max_points=1_000)
    assert len(points) > 2_000
    assert 750 < len(few) <= 1_000
    # Thinned by cells: the few still reach as far as the many.
    assert np.ptp(few, axis=0) == pytest.approx(np.ptp(points, axis=0), rel=0.1)


def test_absent_cameras_and_masked_pixels_give_no_points() -> None:
    """Half of every picture is masked, and one camera is absent: points lie where the others' halves look."""
    frame = next(iter(CLIP.frames()))
    masks = {name: np.ones(image.shape[:2], bool) for name, image in frame.images.items()}
    for mask in masks.values():
        mask[:, len(mask[0]) // 2 :] = False
    absent = CLIP.rig.training[2]
    images = {name: image for name, image in frame.images.items() if name != absent}
    config = varied(PointsConfig(max_points=20_000), SWEEP_LEVELS=COARSE, RANDOM_POINTS=100)
    found = initial_points(MultiViewFrame(0, 0.0, images, masks), CLIP.rig, config=config)
    assert len(found) > 300
    whole = initial_points(frame, CLIP.rig, config=config)

    def shown(points: np.ndarray) -> float:
        """Share of the points that some camera shows at a pixel that counts."""
        seen = np.zeros(len(points), bool)
        for name in CLIP.rig.training:
            if name == absent:
                continue
            camera = CLIP.rig[name]
            pixels, depths = project(camera, points)
            within = inside(camera, pixels, depths, near=0.0)
            column, row = pixels[within].astype(np.intp).T
            seen[within] |= masks[name][row, column]
        return float(seen.mean())

    assert shown(found) > 0.99
    assert shown(whole) < shown(found)


def test_random_points_lie_behind_pixels_that_count() -> None:
    frame = next(iter(CLIP.frames()))
    masks = {name: np.ones(image.shape[:2], bool) for name, image in frame.images.items()}
    masks[CLIP.rig.training[0]][:, 3:] = False
    config = varied(PointsConfig(), MIN_POINTS=10**6, RANDOM_POINTS=900, SWEEP_LEVELS=())
    found = initial_points(MultiViewFrame(0, 0.0, frame.images, masks), CLIP.rig, config=config)
    assert 750 < len(found) < 850  # one of nine cameras gives nearly none


def test_cameras_that_look_away_from_each_other_give_random_points() -> None:
    """As inverted poses do, of which the check tells afterwards."""
    frame = next(iter(CLIP.frames()))
    inverted = {name: replace(camera, viewmat=camera.viewmat.inverse()) for name, camera in CLIP.rig.cameras.items()}
    config = varied(PointsConfig(), RANDOM_POINTS=900, SWEEP_LEVELS=())
    assert len(initial_points(frame, CLIP.rig.mapped(inverted), config=config)) == 900


def test_keypoints_are_those_of_pictures_of_the_reference_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of twice the size give the points that they give when they are reduced."""
    clip, config = CLIP, varied(PointsConfig(max_points=20_000), SWEEP_LEVELS=(), MIN_POINTS=1)
    frame, rig = next(iter(clip.frames())), clip.rig
    width, height = rig[rig.training[0]].width, rig[rig.training[0]].height
    large = replace(rig, cameras={name: rig[name].resized(2 * width, 2 * height) for name in rig})
    pictures = {name: image.repeat(2, 0).repeat(2, 1) for name, image in frame.images.items()}
    monkeypatch.setattr(cameras, "REFERENCE_PIXELS", width)
    expected = initial_points(frame, rig, config=config)
    found = initial_points(MultiViewFrame(0, 0.0, pictures), large, config=config)
    assert len(expected) > 100
    np.testing.assert_allclose(found, expected, atol=1e-9)
