# SPDX-License-Identifier: Apache-2.0
"""Flow as maps: where it is believed, and where it is not looked for."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from structgstream.training.online.preprocess import FlowMaps, _parts, flow_map
from tests.support.backends import quickest_backend


def search(
    first: np.ndarray, second: np.ndarray, *, changed: torch.Tensor | None = None, size: tuple[int, int] | None = None
) -> torch.Tensor:
    """Flow maps of ``size``, or that of the pictures, which changed where they differ unless ``changed`` is given."""
    if changed is None:
        changed = torch.from_numpy((first != second).any(2))
    pictures = torch.from_numpy(first), torch.from_numpy(second)
    return flow_map(*pictures, changed, size or first.shape[:2], backend=quickest_backend()).maps


def textured(height: int = 120, width: int = 160) -> np.ndarray:
    noise = np.random.default_rng(5).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), np.empty_like(noise), 0, 255, cv2.NORM_MINMAX)


def test_a_shifted_patch_is_reported_at_half_the_size_in_whole_pixels() -> None:
    first = textured()
    second = first.copy()
    second[40:80, 56:106] = first[40:80, 50:100]  # six to the right
    maps = search(first, second, size=(60, 80))
    assert maps.shape == (60, 80, 3)
    inner = maps[24:36, 30:45]
    confidence, flow = inner[..., 0], inner[..., 1:] / inner[..., :1].clamp(min=1e-6)
    assert confidence.mean() > 0.9
    torch.testing.assert_close(flow[confidence > 0.5].median(0).values, torch.tensor([6.0, 0.0]), atol=0.3, rtol=0)


def test_beyond_the_box_around_what_changed_there_is_no_flow() -> None:
    first = textured()
    changed = torch.zeros(120, 160, dtype=torch.bool)
    changed[50:70, 60:90] = True
    maps = search(first, np.roll(first, 3, 1), changed=changed)
    assert maps[50:70, 60:90, 0].mean() > 0.8
    assert not maps[:30].any()
    assert not maps[:, :40].any()


def test_nothing_changed_is_no_flow() -> None:
    assert not search(textured(), textured(), size=(60, 80)).any()


def test_parts_that_changed_are_searched_apart() -> None:
    first = textured(192, 320)
    second = first.copy()
    second[24:56, 36:76] = first[24:56, 32:72]  # four to the right, up on the left
    second[140:172, 250:290] = first[146:178, 250:290]  # six up, down on the right
    maps = search(first, second)
    left, right = (slice(32, 50), slice(44, 66)), (slice(152, 166), slice(262, 278))
    for (rows, columns), flow in ((left, [4.0, 0.0]), (right, [0.0, -6.0])):
        found = maps[rows, columns]
        assert found[..., 0].mean() > 0.9
        moved = found[..., 1:].flatten(0, 1).median(0).values
        torch.testing.assert_close(moved, torch.tensor(flow), atol=0.3, rtol=0)
    assert not maps[96:110, 150:170].any(), "between the two nothing is searched"


def test_parts_near_each_other_are_searched_together() -> None:
    first = textured()
    changed = torch.zeros(120, 160, dtype=torch.bool)
    changed[40:60, 40:60] = changed[40:60, 90:110] = True
    maps = search(first, np.roll(first, 2, 1), changed=changed)
    assert maps[45:55, 65:85, 0].mean() > 0.9, "also between the two"


WIDTHS = pytest.mark.parametrize("width", [320, 960, 1920])


def thrown(width: int, *, by: float = 60 / 320, body: bool = False) -> tuple[FlowMaps, torch.Tensor]:
    """Flow, at the size of the pictures, of a ball that crosses a share of the width over a resting ground; the ball's
    pixels in the first picture. With ``body`` something large below it moves as well, by a hundredth."""
    height, radius, moved = width * 3 // 4, width // 20, round(by * width)
    small = textured(120, 160)
    ground = cv2.resize(small // 4 + 96, (width, height), interpolation=cv2.INTER_CUBIC)
    skin = cv2.resize(np.ascontiguousarray(small[::-1, ::-1]), (width, height), interpolation=cv2.INTER_AREA)
    rows, columns = np.mgrid[:height, :width]
    ball = (rows - height // 2) ** 2 + (columns - width // 3) ** 2 < radius**2
    first, second = ground.copy(), ground.copy()
    if body:
        below = slice(height * 3 // 5, height)
        first[below], second[below] = skin[below, ::-1], np.roll(skin[below, ::-1], width // 100, 1)
    first[ball], second[np.roll(ball, moved, 1)] = skin[ball], skin[ball]
    pictures = torch.from_numpy(first), torch.from_numpy(second)
    changed = quickest_backend().changed_pixels(*pictures, threshold=0.05, reach_pixels=3)
    found = flow_map(*pictures, changed, (height, width), backend=quickest_backend())
    return found, torch.from_numpy(ball)


@WIDTHS
def test_a_ball_that_crosses_a_share_of_the_width_is_found_at_every_size(width: int) -> None:
    by = 0.14
    found, ball = thrown(width, by=by)
    assert found.counts["far boxes"] == 1, "the old and the new place are searched together"
    confidence, flow = found.maps[ball][:, 0], found.maps[ball][:, 1:]
    assert confidence.mean() > 0.7
    expected = torch.tensor([round(by * width), 0.0])
    right = (flow - expected).norm(dim=1) < 0.01 * width
    assert right[confidence > 0].float().mean() > 0.95
    assert found.counts["far pixels"] > 0.9 * int((confidence > 0).sum())


@WIDTHS
def test_a_ball_is_found_next_to_a_body_whose_flow_is_consistent(width: int) -> None:
    found, ball = thrown(width, by=0.14, body=True)
    assert found.counts["far boxes"] == 1
    expected = torch.tensor([round(0.14 * width), 0.0])
    confidence, flow = found.maps[ball][:, 0], found.maps[ball][:, 1:]
    assert (confidence * ((flow - expected).norm(dim=1) < 0.01 * width)).mean() > 0.6


@WIDTHS
def test_what_does_not_move_far_is_searched_once(width: int) -> None:
    assert thrown(width, by=0.01)[0].counts["far boxes"] == 0


def test_where_there_is_nothing_to_find_no_far_flow_is_found() -> None:
    """A ball that appears, on a ground that rests: what is found of it in the ground is not found back."""
    first = cv2.resize(textured(), (640, 480)) // 4 + 96
    second = first.copy()
    cv2.circle(second, (300, 200), 30, (250, 40, 40), -1)
    pictures = torch.from_numpy(first), torch.from_numpy(second)
    changed = quickest_backend().changed_pixels(*pictures, threshold=0.05, reach_pixels=3)
    found = flow_map(*pictures, changed, (480, 640), backend=quickest_backend())
    assert found.counts["far boxes"] == 1
    far = found.maps[..., 1:].norm(dim=-1) > 8.0
    assert (far & changed).sum() < 0.02 * changed.sum()
    assert not (far & ~changed).any()


@given(cells=st.integers(1, 12).flatmap(lambda n: arrays(np.bool_, (n, 13), elements=st.booleans())))
def test_boxes_of_parts_are_disjoint_and_hold_every_part(cells: np.ndarray) -> None:
    covered = np.zeros(cells.shape, int)
    for top, bottom, left, right in _parts(cells):
        covered[top:bottom, left:right] += 1
    assert covered.max(initial=0) <= 1
    assert (covered[cells] == 1).all()
