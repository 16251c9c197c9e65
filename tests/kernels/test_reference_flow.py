# SPDX-License-Identifier: Apache-2.0
import numpy as np
import torch

from structgstream.flow import ABSOLUTE, RELATIVE, consistency_mask
from structgstream.kernels.reference_flow import confident_flow


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
