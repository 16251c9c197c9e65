# SPDX-License-Identifier: Apache-2.0
"""The scores of a picture (``test_metrics`` and ``test_masks`` have each of them by itself)."""

import numpy as np
import pytest

from structgstream.errors import CaptureError
from structgstream.evaluation.metrics import PSNR_OF_EQUALS, counting, score
from structgstream.kernels.backend import reference_backend


def test_every_pixel_changed_leaves_no_still_one() -> None:
    dark, bright = np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 200, np.uint8)
    scores = score(bright, bright, dark, backend=reference_backend())
    assert (scores.changed_share, scores.psnr_still) == (1.0, None)
    assert scores.psnr_changed == PSNR_OF_EQUALS


def test_pictures_of_different_sizes_are_reported() -> None:
    small, large = np.zeros((8, 9, 3), np.uint8), np.zeros((16, 18, 3), np.uint8)
    with pytest.raises(CaptureError, match="9x8 pixels .* truth of 18x16"):
        score(small, large, large, backend=reference_backend())


def test_what_a_mask_leaves_out_does_not_count() -> None:
    random = np.random.default_rng(0)
    first, truth = (random.integers(0, 256, (24, 32, 3), np.uint8) for _ in range(2))
    mask = np.zeros((24, 32), bool)
    mask[:, :20] = True
    picture = np.where(mask[..., None], truth, 0).astype(np.uint8)
    scores = score(picture, np.where(mask[..., None], truth, 0).astype(np.uint8), first, backend=reference_backend(),
                   mask=mask)  # fmt: skip
    assert scores.psnr == PSNR_OF_EQUALS
    assert counting(mask, truth)[0].shape == (24 * 20, 1, 3)
    assert counting(None, truth)[0] is truth
