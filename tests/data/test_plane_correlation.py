# SPDX-License-Identifier: Apache-2.0
"""Parts of the correlation against the plain way of computing them."""

import numpy as np
import pytest

from planes import room_frame, room_rig
from structgstream.data.plane_correlation import Neighbour, ReferenceWindow, facing, largest, plane_score
from structgstream.data.plane_sweep import sweep_view


@pytest.mark.parametrize(("images", "count"), [(1, 1), (2, 1), (2, 2), (3, 2), (4, 2), (5, 3), (6, 3)])
def test_largest_are_those_of_a_sort(images: int, count: int) -> None:
    # Few levels, so that many values are equal.
    given = np.random.default_rng(0).integers(-1, 4, (images, 7, 5)).astype(np.float32)
    found = largest(list(given), count)
    assert found.dtype == np.float32
    assert np.array_equal(np.sort(found, 0), np.sort(given, 0)[-count:])


@pytest.mark.parametrize(("row", "expected"), [((0, 0, 1), True), ((0, 0, -1), False), ((0.2, -0.1, -0.5), None)])
def test_pixels_in_front_are_those_of_positive_depth(row: tuple[float, ...], expected: bool | None) -> None:
    homography = np.eye(3)
    homography[2] = row
    found = facing(homography, 6, 9)
    rows, columns = np.mgrid[:6, :9]
    depth = row[0] * columns + row[1] * rows + row[2]
    assert np.array_equal(np.broadcast_to(found, (6, 9)), depth > 1e-6)
    assert isinstance(found, bool) == (expected is not None)


def test_a_picture_correlates_with_itself_on_any_plane() -> None:
    rig = room_rig()
    view = sweep_view(rig["cam02"], room_frame(rig).images["cam02"], width=80)
    window = ReferenceWindow.of(view.grey, size=5, noise=0.0)
    same = Neighbour.of(view.camera, view.camera, view.grey)
    score = plane_score(window, [same], np.array([0.0, 0.0, 0.5]))
    assert np.median(score[3:-3, 3:-3]) == pytest.approx(1.0, abs=1e-3)


def test_a_plane_behind_the_neighbour_is_not_seen() -> None:
    rig = room_rig()
    view = sweep_view(rig["cam02"], room_frame(rig).images["cam02"], width=80)
    window = ReferenceWindow.of(view.grey, size=5, noise=0.008)
    turned = Neighbour.of(view.camera, view.camera, view.grey)
    turned = Neighbour(turned.grey, np.diag([-1.0, 1.0, -1.0, 1.0]), turned.to_ray, turned.to_pixel)
    assert (plane_score(window, [turned], np.array([0.0, 0.0, 0.5])) == -0.5).all()
