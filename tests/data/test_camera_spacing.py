# SPDX-License-Identifier: Apache-2.0
"""Angles between cameras, and what they leave for new viewpoints."""

import math
from dataclasses import replace

import pytest
import torch

from structgstream.data import camera_spacing as spacing
from tests.support.planes import room_rig
from tests.support.rigs import evenly, ring


def test_parallel_cameras_are_seen_from_five_times_their_spread() -> None:
    cameras = {f"cam{i}": replace(room_rig()["cam02"], viewmat=shifted(i)) for i in range(5)}
    # 1 apart, seen from 10 away; the ends of the row have their second neighbour at 2.
    assert spacing.camera_spacing(cameras) == pytest.approx(math.degrees(math.atan(0.1)), rel=0.05)


def shifted(steps: int) -> torch.Tensor:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -float(steps)
    return viewmat


@pytest.mark.parametrize(("count", "apart"), [(4, 90.0), (8, 45.0), (24, 15.0)])
def test_a_ring_is_as_far_apart_as_its_neighbours_at_any_size(count: int, apart: float) -> None:
    for radius in (0.1, 30.0):
        cameras = ring([apart * i for i in range(count)], radius=radius)
        assert spacing.camera_spacing(cameras) == pytest.approx(apart, abs=0.1)


def test_a_pair_on_one_tripod_surrounds_nothing() -> None:
    assert spacing.camera_spacing(ring([0, 1, 60, 61, 120, 121])) == pytest.approx(59.5, abs=1.0)


def test_two_cameras() -> None:
    assert spacing.camera_spacing(ring([0, 40])) == pytest.approx(40.0, abs=0.1)


def test_what_is_expected_falls_with_the_angle_and_ends_with_what_was_measured() -> None:
    angles, measured = zip(*spacing.MEASURED, strict=True)
    assert [*angles] == sorted(angles)
    assert [spacing.expected_psnr(angle) for angle in angles] == pytest.approx(measured)
    assert [*measured] == sorted(measured, reverse=True)
    assert spacing.expected_psnr(170.0) == measured[-1]


def test_few_cameras_are_told_what_to_expect_and_what_more_of_them_would_give() -> None:
    expected = spacing.expectation(evenly(4, 90.0))
    assert expected is not None
    assert expected.poor
    low, high = spacing.expected_psnr(90.0 * spacing.SPREAD), spacing.expected_psnr(90.0 / spacing.SPREAD)
    assert expected.sentence.startswith(f"4 cameras, about 90 degrees apart: expect {low:.0f} to {high:.0f} dB ")
    many = math.ceil(4 * 4.5 ** (1 / spacing.COUNT_EXPONENT))
    assert f"{spacing.expected_psnr(20.0):.0f} with {many}" in expected.sentence
    eight = spacing.expected_psnr(90.0 * 0.5**spacing.COUNT_EXPONENT)
    assert f"(about {eight:.0f} with 8, " in expected.sentence


def test_a_little_too_far_apart_is_no_warning_and_close_cameras_are_not_mentioned() -> None:
    expected = spacing.expectation(evenly(8, 25.0))
    assert expected is not None
    assert not expected.poor
    assert expected.sentence.count(" with ") == 1, "twice as many would be more than is asked for"
    assert spacing.expectation(evenly(24, 15.0)) is None


def test_cameras_that_look_apart_are_promised_nothing() -> None:
    """A rig in the middle of a room: 12 cameras 30 degrees apart around the same scene would give 30 dB."""
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    around = evenly(12, 30.0)
    outward = {name: replace(camera, viewmat=turn @ camera.viewmat) for name, camera in around.items()}
    inside, outside = spacing.expectation(around), spacing.expectation(outward)
    assert inside is not None
    assert not inside.poor
    assert outside is not None
    assert outside.poor
    assert "12 cameras that look away from each other" in outside.sentence
    assert " dB " not in outside.sentence


def test_where_a_little_more_or_less_decides_it_is_a_warning() -> None:
    expected = spacing.expectation(evenly(7, 48.0))
    assert expected is not None
    assert expected.poor
    assert "expect 21 to 28 dB" in expected.sentence
