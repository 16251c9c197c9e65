# SPDX-License-Identifier: Apache-2.0
"""Changed pixels, residuals and consistent flow in C++ beside the oracle."""

import pytest
import torch

from structgstream.flow import ABSOLUTE, RELATIVE
from structgstream.kernels import cpu_motion, reference_motion
from structgstream.kernels.values import TileSelection, tile_grid
from tests.support.backends import needs_native

pytestmark = needs_native


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (37, 53), (64, 80)])
@pytest.mark.parametrize("reach_pixels", [0, 3])
def test_changed_pixels_are_the_same(size: tuple[int, int], reach_pixels: int) -> None:
    g = torch.Generator().manual_seed(3)
    before = torch.randint(0, 256, (*size, 3), generator=g, dtype=torch.uint8)
    noise = torch.randint(-12, 13, (*size, 3), generator=g)
    noise[size[0] // 2 :, size[1] // 2 :] *= 3
    now = (before + noise).clamp(0, 255).to(torch.uint8)
    for threshold in (0.0, 0.02, 0.05, 1.0):
        ours = cpu_motion.changed_pixels(before, now, threshold=threshold, reach_pixels=reach_pixels)
        theirs = reference_motion.changed_pixels(before, now, threshold=threshold, reach_pixels=reach_pixels)
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize(
    ("size", "reduced"), [((37, 53), (37, 53)), ((36, 54), (18, 27)), ((37, 53), (20, 31)), ((1, 1), (1, 1))]
)
@pytest.mark.parametrize("corrected", [False, True])
@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_residual(size: tuple[int, int], reduced: tuple[int, int], corrected: bool, tiled: bool, masked: bool) -> None:
    g = torch.Generator().manual_seed(2)
    height, width = size
    renderings = torch.rand(2, *size, 3, generator=g) * 1.4 - 0.2  # Beyond what a picture can show.
    pictures = torch.randint(256, (2, *reduced, 3), generator=g, dtype=torch.uint8)
    selections = torch.rand(2, *tile_grid(width, height), generator=g) < 0.5
    given = {
        "gains": torch.rand(2, 3, generator=g) + 0.5 if corrected else None,
        "biases": torch.rand(2, 3, generator=g) * 0.2 if corrected else None,
        "tiles": [TileSelection(mask, width, height) for mask in selections] if tiled else None,
        "outside": torch.randint(256, (2, *size, 3), generator=g, dtype=torch.uint8) if tiled else None,
        "masks": torch.rand(2, *reduced, generator=g) < 0.8 if masked else None,
    }
    exact = reference_motion.picture_residuals(renderings, pictures, **given)
    ours = cpu_motion.picture_residuals(renderings, pictures, **given)
    assert ours.shape == exact.shape == (2, *reduced)
    torch.testing.assert_close(ours, exact, atol=2e-6, rtol=0)
    assert exact.max() > 0.05 or (masked and min(reduced) == 1)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (33, 47), (64, 80)])
@pytest.mark.parametrize("masked", [False, True])
def test_the_same_pixels_have_confidence(size: tuple[int, int], masked: bool) -> None:
    g = torch.Generator().manual_seed(5)
    flow = 3.0 * torch.randn(*size, 2, generator=g)
    back = 0.5 * torch.randn(*size, 2, generator=g) - flow.mean((0, 1))
    flow[::3] = flow.mean((0, 1))
    mask = torch.rand(size, generator=g) > 0.3 if masked else None
    ours = cpu_motion.confident_flow(flow, back, mask, relative=RELATIVE, absolute=ABSOLUTE)
    theirs = reference_motion.confident_flow(flow, back, mask, relative=RELATIVE, absolute=ABSOLUTE)
    both = (ours[0] > 0) & (theirs[0] > 0)
    assert torch.equal(ours[:, both], theirs[:, both])
    assert (ours[0] != theirs[0]).float().mean() < 1e-3, "rounding of a sum decides only at the limit"
    assert both.any() == (min(size) > 1)


def test_not_a_number_has_no_confidence() -> None:
    flow = torch.full((4, 4, 2), float("nan"))
    maps = cpu_motion.confident_flow(flow, torch.zeros(4, 4, 2), None, relative=RELATIVE, absolute=ABSOLUTE)
    assert not maps.any()
