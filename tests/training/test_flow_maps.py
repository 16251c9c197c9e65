# SPDX-License-Identifier: Apache-2.0
"""Flow as maps: where it is believed, and where it is not looked for."""

from functools import partial

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from structgstream.errors import ConfigError
from structgstream.kernels.backend import reference_backend
from structgstream.training.flow_maps import FlowConfig, _parts, flow_map

one_box = partial(flow_map, config=FlowConfig(), backend=reference_backend())
boxes_apart = partial(flow_map, config=FlowConfig(apart=True), backend=reference_backend())


def textured(height: int = 120, width: int = 160) -> np.ndarray:
    noise = np.random.default_rng(5).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), np.empty_like(noise), 0, 255, cv2.NORM_MINMAX)


def test_a_shifted_patch_is_told_at_half_the_size_in_whole_pixels() -> None:
    first = textured()
    second = first.copy()
    second[40:80, 56:106] = first[40:80, 50:100]  # six to the right
    changed = torch.from_numpy(np.abs(first.astype(int) - second).sum(2) > 0)
    maps = one_box(torch.from_numpy(first), torch.from_numpy(second), changed, (60, 80))
    assert maps.shape == (60, 80, 3)
    inner = maps[24:36, 30:45]
    confidence, flow = inner[..., 0], inner[..., 1:] / inner[..., :1].clamp(min=1e-6)
    assert confidence.mean() > 0.9
    torch.testing.assert_close(flow[confidence > 0.5].median(0).values, torch.tensor([6.0, 0.0]), atol=0.3, rtol=0)


def test_small_pictures_are_searched_up_to_their_full_size() -> None:
    config = FlowConfig()
    assert [config.level_of(width) for width in (160, 320, 479, 480, 640, 1920)] == [0, 0, 0, 1, 1, 1]
    assert FlowConfig(finest_level=2).level_of(640) == 1
    assert FlowConfig(least_width=0).level_of(160) == 1
    with pytest.raises(ConfigError, match="finest level -1"):
        FlowConfig(finest_level=-1)


def test_beyond_the_box_around_what_changed_there_is_no_flow() -> None:
    first = textured()
    second = np.roll(first, 3, 1)
    changed = torch.zeros(120, 160, dtype=torch.bool)
    changed[50:70, 60:90] = True
    maps = one_box(torch.from_numpy(first), torch.from_numpy(second), changed, (120, 160))
    assert maps[50:70, 60:90, 0].mean() > 0.8
    assert not maps[:30].any()
    assert not maps[:, :40].any()


def test_nothing_changed_is_no_flow() -> None:
    picture = torch.from_numpy(textured())
    assert not one_box(picture, picture, torch.zeros(120, 160, dtype=torch.bool), (60, 80)).any()


def test_flow_is_repeated_bit_for_bit() -> None:
    first = textured()
    second = np.roll(first, (2, 5), (0, 1))
    changed = torch.ones(120, 160, dtype=torch.bool)
    given = (torch.from_numpy(first), torch.from_numpy(second), changed, (60, 80))
    assert torch.equal(one_box(*given), one_box(*given))


def test_parts_that_changed_are_searched_apart() -> None:
    first = textured(192, 320)
    second = first.copy()
    second[24:56, 36:76] = first[24:56, 32:72]  # four to the right, up on the left
    second[140:172, 250:290] = first[146:178, 250:290]  # six up, down on the right
    changed = torch.from_numpy(np.abs(first.astype(int) - second).sum(2) > 0)
    pictures = torch.from_numpy(first), torch.from_numpy(second)
    one, apart = (search(*pictures, changed, (192, 320)) for search in (one_box, boxes_apart))
    left, right = (slice(32, 50), slice(44, 66)), (slice(152, 166), slice(262, 278))
    for (rows, columns), flow in ((left, [4.0, 0.0]), (right, [0.0, -6.0])):
        for maps in (one, apart):
            found = maps[rows, columns]
            assert found[..., 0].mean() > 0.9
            moved = found[..., 1:].flatten(0, 1).median(0).values
            torch.testing.assert_close(moved, torch.tensor(flow), atol=0.3, rtol=0)
    assert one[96:110, 150:170, 0].mean() > 0.9  # between the two nothing changed, which a search tells, too
    assert not apart[96:110, 150:170].any()


def test_parts_near_each_other_are_searched_together() -> None:
    first = textured()
    second = np.roll(first, 2, 1)
    changed = torch.zeros(120, 160, dtype=torch.bool)
    changed[40:60, 40:60] = changed[40:60, 90:110] = True
    pictures = torch.from_numpy(first), torch.from_numpy(second)
    one, apart = (search(*pictures, changed, (120, 160)) for search in (one_box, boxes_apart))
    assert torch.equal(one, apart)


@given(cells=st.integers(1, 12).flatmap(lambda n: arrays(np.bool_, (n, 13), elements=st.booleans())))
def test_boxes_of_parts_are_disjoint_and_hold_every_part(cells: np.ndarray) -> None:
    covered = np.zeros(cells.shape, int)
    for top, bottom, left, right in _parts(cells):
        covered[top:bottom, left:right] += 1
    assert covered.max(initial=0) <= 1
    assert (covered[cells] == 1).all()
