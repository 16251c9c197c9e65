# SPDX-License-Identifier: Apache-2.0
"""The oracle of residuals, by hand."""

import torch

from structgstream.kernels.raster_types import TileSelection
from structgstream.kernels.reference_residual import picture_residual

PICTURE = torch.randint(256, (6, 7, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def test_equal_pictures_have_no_residual() -> None:
    assert not picture_residual(PICTURE.float() / 255.0, PICTURE).any()


def test_a_difference_is_a_mean_over_the_pixels_around() -> None:
    rendering = torch.zeros(6, 7, 3)
    rendering[0, 0] = torch.tensor([0.9, 0.3, 0.6])
    found = picture_residual(rendering, torch.zeros(6, 7, 3, dtype=torch.uint8))
    torch.testing.assert_close(found[0, 0], torch.tensor(0.6 / 4))
    torch.testing.assert_close(found[0, 1], torch.tensor(0.6 / 6))
    torch.testing.assert_close(found[1, 1], torch.tensor(0.6 / 9))
    assert not found[2:].any()
    assert not found[:, 2:].any()


def test_a_rendering_is_what_the_camera_records_of_it() -> None:
    white = torch.full((6, 7, 3), 255, dtype=torch.uint8)
    gains, biases = torch.tensor([2.0, 1.0, 4.0]), torch.tensor([0.0, 0.5, -0.2])
    assert not picture_residual(torch.full((6, 7, 3), 0.7), white, gains=gains, biases=biases).any(), "not above white"
    found = picture_residual(torch.full((6, 7, 3), 0.3), white, gains=gains, biases=biases)
    torch.testing.assert_close(found, torch.full((6, 7), (0.4 + 0.2 + 0.0) / 3))


def test_a_larger_rendering_is_averaged() -> None:
    rendering = torch.zeros(12, 14, 3)
    rendering[::2, ::2] = 1.0
    found = picture_residual(rendering, torch.zeros(6, 7, 3, dtype=torch.uint8))
    torch.testing.assert_close(found, torch.full((6, 7), 0.25))


def test_outside_of_tiles_it_is_another_picture() -> None:
    tiles = TileSelection(torch.tensor([[True, False]]), 32, 16)
    black = torch.zeros(16, 32, 3, dtype=torch.uint8)
    found = picture_residual(torch.ones(16, 32, 3), black, tiles=tiles, outside=black)
    assert (found[:, :15] == 1.0).all()
    assert not found[:, 17:].any()


def test_masked_pixels_do_not_differ_and_touch_no_others() -> None:
    mask = torch.ones(6, 7, dtype=torch.bool)
    mask[2, 3] = False
    rendering = torch.zeros(6, 7, 3)
    rendering[2, 3] = 1.0
    assert not picture_residual(rendering, torch.zeros(6, 7, 3, dtype=torch.uint8), mask=mask).any()
