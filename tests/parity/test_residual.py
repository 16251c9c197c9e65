# SPDX-License-Identifier: Apache-2.0
"""Residuals of renderings in C++ beside the oracle."""

import pytest
import torch

from structgstream.kernels import cpu_residual, reference_residual
from structgstream.kernels._load import native_reason
from structgstream.kernels.raster_types import TileSelection, tile_grid

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize(
    ("size", "reduced"), [((37, 53), (37, 53)), ((36, 54), (18, 27)), ((37, 53), (20, 31)), ((1, 1), (1, 1))]
)
@pytest.mark.parametrize("corrected", [False, True])
@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_residual(size: tuple[int, int], reduced: tuple[int, int], corrected: bool, tiled: bool, masked: bool) -> None:
    g = torch.Generator().manual_seed(2)
    height, width = size
    rendering = torch.rand(*size, 3, generator=g) * 1.4 - 0.2  # Beyond what a picture can show.
    picture = torch.randint(256, (*reduced, 3), generator=g, dtype=torch.uint8)
    tiles = TileSelection(torch.rand(tile_grid(width, height), generator=g) < 0.5, width, height) if tiled else None
    outside = torch.randint(256, (*size, 3), generator=g, dtype=torch.uint8) if tiled else None
    mask = torch.rand(reduced, generator=g) < 0.8 if masked else None
    color = (torch.rand(3, generator=g) + 0.5, torch.rand(3, generator=g) * 0.2) if corrected else (None, None)
    given = {"gains": color[0], "biases": color[1], "tiles": tiles, "outside": outside, "mask": mask}
    exact = reference_residual.picture_residual(rendering, picture, **given)
    ours = cpu_residual.picture_residual(rendering, picture, **given)
    assert ours.shape == exact.shape == reduced
    torch.testing.assert_close(ours, exact, atol=2e-6, rtol=0)
    assert exact.max() > 0.05 or (masked and min(reduced) == 1)
