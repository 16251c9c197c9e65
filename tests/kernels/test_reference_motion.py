# SPDX-License-Identifier: Apache-2.0
"""Changed pixels, residuals and consistent flow of the reference, beside what is known by hand."""

from typing import Any

import numpy as np
import torch

from structgstream.flow import ABSOLUTE, RELATIVE, consistency_mask
from structgstream.kernels.reference_motion import changed_pixels, confident_flow, picture_residuals
from structgstream.kernels.values import TileSelection


def test_what_changed_and_its_surroundings() -> None:
    before = torch.full((20, 30, 3), 100, dtype=torch.uint8)
    now = before.clone()
    now[10, 15] = 190  # 90 / 255 over nine pixels: a mean of 0.039
    assert not changed_pixels(before, now, threshold=0.04, reach_pixels=2).any()
    found = changed_pixels(before, now, threshold=0.035, reach_pixels=0)
    assert found.sum() == 9
    assert found[9:12, 14:17].all()
    assert changed_pixels(before, now, threshold=0.035, reach_pixels=2)[7:14, 12:19].all()


def test_darker_is_a_change_as_brighter_is_and_a_corner_has_fewer_neighbours() -> None:
    before = torch.full((8, 8, 3), 100, dtype=torch.uint8)
    now = before.clone()
    now[0, 0] = 30  # 70 / 255 over four pixels
    assert changed_pixels(before, now, threshold=0.06, reach_pixels=0).sum() == 1


def residual_of(rendering: torch.Tensor, picture: torch.Tensor, **options: Any) -> torch.Tensor:
    """The residual of one view."""
    return picture_residuals([rendering], picture[None], **{name: value[None] for name, value in options.items()})[0]


PICTURE = torch.randint(256, (6, 7, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def test_equal_pictures_have_no_residual() -> None:
    assert not residual_of(PICTURE.float() / 255.0, PICTURE).any()


def test_a_difference_is_a_mean_over_the_pixels_around() -> None:
    rendering = torch.zeros(6, 7, 3)
    rendering[0, 0] = torch.tensor([0.9, 0.3, 0.6])
    found = residual_of(rendering, torch.zeros(6, 7, 3, dtype=torch.uint8))
    torch.testing.assert_close(found[0, 0], torch.tensor(0.6 / 4))
    torch.testing.assert_close(found[0, 1], torch.tensor(0.6 / 6))
    torch.testing.assert_close(found[1, 1], torch.tensor(0.6 / 9))
    assert not found[2:].any()
    assert not found[:, 2:].any()


def test_a_rendering_is_what_the_camera_records_of_it() -> None:
    white = torch.full((6, 7, 3), 255, dtype=torch.uint8)
    gains, biases = torch.tensor([2.0, 1.0, 4.0]), torch.tensor([0.0, 0.5, -0.2])
    assert not residual_of(torch.full((6, 7, 3), 0.7), white, gains=gains, biases=biases).any(), "not above white"
    found = residual_of(torch.full((6, 7, 3), 0.3), white, gains=gains, biases=biases)
    torch.testing.assert_close(found, torch.full((6, 7), (0.4 + 0.2 + 0.0) / 3))


def test_a_larger_rendering_is_averaged() -> None:
    rendering = torch.zeros(12, 14, 3)
    rendering[::2, ::2] = 1.0
    found = residual_of(rendering, torch.zeros(6, 7, 3, dtype=torch.uint8))
    torch.testing.assert_close(found, torch.full((6, 7), 0.25))


def test_outside_of_tiles_it_is_another_picture() -> None:
    tiles = TileSelection(torch.tensor([[True, False]]), 32, 16)
    black = torch.zeros(16, 32, 3, dtype=torch.uint8)
    (found,) = picture_residuals([torch.ones(16, 32, 3)], black[None], tiles=[tiles], outside=[black])
    assert (found[:, :15] == 1.0).all()
    assert not found[:, 17:].any()


def test_masked_pixels_do_not_differ_and_touch_no_others() -> None:
    mask = torch.ones(6, 7, dtype=torch.bool)
    mask[2, 3] = False
    rendering = torch.zeros(6, 7, 3)
    rendering[2, 3] = 1.0
    assert not residual_of(rendering, torch.zeros(6, 7, 3, dtype=torch.uint8), masks=mask).any()


def shift(x: float, y: float, height: int = 6, width: int = 9) -> torch.Tensor:
    return torch.tensor([x, y]).expand(height, width, 2).contiguous()


def test_flow_there_and_back_agrees_inside_the_picture() -> None:
    maps = confident_flow(shift(2.0, 1.0), shift(-2.0, -1.0), None, relative=RELATIVE, absolute=ABSOLUTE)
    assert maps.shape == (3, 6, 9)
    assert maps[:, :5, :7].flatten(1).unique(dim=1).tolist() == [[1.0], [2.0], [1.0]]
    assert not maps[:, 5:].any()  # leaves the picture below
    assert not maps[:, :, 7:].any()  # and on the right


def test_disagreement_beyond_the_limit_has_no_confidence() -> None:
    for beyond, found in ((0.6, 1.0), (0.9, 0.0)):  # 0.36 and 0.81 squared pixels
        maps = confident_flow(shift(0.0, 0.0), shift(beyond, 0.0), None, relative=0.0, absolute=ABSOLUTE)
        assert (maps[0] == found).all()


def test_masked_pixels_have_no_confidence() -> None:
    mask = torch.zeros(6, 9, dtype=torch.bool)
    mask[2, 3] = True
    maps = confident_flow(shift(1.0, 0.0), shift(-1.0, 0.0), mask, relative=RELATIVE, absolute=ABSOLUTE)
    assert maps[0].nonzero().tolist() == [[2, 3]]


def test_it_is_the_mask_by_which_flow_is_scored() -> None:
    g = np.random.default_rng(2)
    there, back = (g.normal(scale=1.5, size=(20, 30, 2)).astype(np.float32) for _ in range(2))
    maps = confident_flow(torch.from_numpy(there), torch.from_numpy(back), None, relative=RELATIVE, absolute=ABSOLUTE)
    np.testing.assert_array_equal(maps[0].numpy() > 0, consistency_mask(there, back))
