# SPDX-License-Identifier: Apache-2.0
"""Depth of a room of textured planes, whose cameras differ in exposure.

Homographies against projections of points of a plane, and scores of the plane where a picture's surface is.
"""

from dataclasses import replace

import numpy as np
import pytest

from structgstream.data.matching import level_normal, neighbor_views
from structgstream.data.plane_sweep import (
    DepthMap,
    SweepBounds,
    SweepConfig,
    consistent_pixels,
    sweep_depth,
    sweep_points,
    sweep_view,
)
from tests.support.planes import WIDTH, distance_to_surface, room_depth, room_frame, room_rig

CONFIG = SweepConfig(width=WIDTH)
BOUNDS = SweepBounds((1.0, 5.0))


def depth_map(config: SweepConfig, bounds: SweepBounds = BOUNDS, *, textured: bool = True) -> DepthMap:
    rig = room_rig()
    frame = room_frame(rig, textured=textured)
    reference, *others = (
        sweep_view(rig[name], frame.images[name], width=config.width)
        for name in ("cam02", "cam01", "cam03", "cam00", "cam04")
    )
    return sweep_depth(reference, others, bounds=bounds, config=config)


def relative_errors(found: DepthMap) -> np.ndarray:
    return np.abs(1 / found.inverse_depth / room_depth(room_rig()["cam02"]) - 1)


@pytest.fixture(scope="module")
def fronto() -> DepthMap:
    return depth_map(CONFIG)


def test_depth_of_believed_pixels_is_right(fronto: DepthMap) -> None:
    errors = relative_errors(fronto)[fronto.believed]
    assert fronto.believed.mean() > 0.5
    assert np.median(errors) < 0.005
    assert (errors < 0.05).mean() > 0.95


def test_the_parabola_refines_the_plane(fronto: DepthMap) -> None:
    """Depth between two planes is found to a fraction of their distance."""
    truth = 1 / room_depth(room_rig()["cam02"])
    off = np.abs(fronto.inverse_depth - truth)[fronto.believed] / fronto.step
    assert np.median(off) < 0.2  # A quarter would be the nearest plane's.


def test_level_planes_find_more_of_the_floor(fronto: DepthMap) -> None:
    camera = room_rig()["cam02"]
    up = level_normal(dict(room_rig().cameras))
    np.testing.assert_allclose(up, [0, -1, 0], atol=0.02)
    wide = replace(CONFIG, window=11)
    level = depth_map(replace(wide, level_planes=True), SweepBounds((1.0, 5.0), up, (-1.0, 0.8)))
    floor = np.zeros(fronto.believed.shape, bool)
    floor[-25:] = True
    assert np.allclose(room_depth(camera)[-25:], room_depth(camera)[-25:, :1], rtol=0.2)
    plain = depth_map(wide)
    right = [(found.believed & (relative_errors(found) < 0.01))[floor].mean() for found in (plain, level)]
    assert right[1] > 2 * right[0]


def test_plain_pictures_are_not_believed() -> None:
    assert not depth_map(CONFIG, textured=False).believed.any()


def test_a_depth_that_other_views_contradict_is_dropped(fronto: DepthMap) -> None:
    rig, agreeing = room_rig(), []
    for name in ("cam00", "cam01", "cam03"):
        truth = 1 / room_depth(rig[name])
        agreeing.append(DepthMap(rig[name], truth, fronto.step, np.ones(truth.shape, bool)))
    points, mask = consistent_pixels(fronto, agreeing, config=CONFIG)
    assert len(points) == mask.sum() > 0.8 * fronto.believed.sum()
    assert np.percentile(distance_to_surface(points), 95) < 0.02
    wrong = replace(fronto, inverse_depth=fronto.inverse_depth * 1.25)
    assert consistent_pixels(wrong, agreeing, config=CONFIG)[1].sum() < 0.05 * mask.sum()


def test_points_lie_on_the_planes_whatever_the_number_of_threads() -> None:
    rig = room_rig()
    frame = room_frame(rig)
    cameras = {name: rig[name] for name in rig.training}

    def points(workers: int) -> np.ndarray:
        return sweep_points(
            cameras,
            frame.images,
            {},
            neighbours=neighbor_views(cameras, count=4, distance=2.6),
            bounds=dict.fromkeys(cameras, BOUNDS),
            workers=workers,
            levels=(CONFIG, SweepConfig(width=60, window=7)),
        )

    one, three = points(1), points(3)
    assert np.array_equal(one, three)
    assert len(one) > 10_000
    assert np.percentile(distance_to_surface(one), 90) < 0.03
