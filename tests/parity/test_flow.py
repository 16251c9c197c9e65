# SPDX-License-Identifier: Apache-2.0
"""Consistent flow in C++ beside the oracle: the same numbers, apart from pixels at the limit."""

import pytest
import torch

from structgstream.flow import ABSOLUTE, RELATIVE
from structgstream.kernels import cpu_flow, reference_flow
from structgstream.kernels._load import native_reason

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (33, 47), (64, 80)])
@pytest.mark.parametrize("masked", [False, True])
def test_the_same_pixels_agree(size: tuple[int, int], masked: bool) -> None:
    g = torch.Generator().manual_seed(5)
    flow = 3.0 * torch.randn(*size, 2, generator=g)
    back = 0.5 * torch.randn(*size, 2, generator=g) - flow.mean((0, 1))
    flow[::3] = flow.mean((0, 1))
    mask = torch.rand(size, generator=g) > 0.3 if masked else None
    ours = cpu_flow.confident_flow(flow, back, mask, relative=RELATIVE, absolute=ABSOLUTE)
    theirs = reference_flow.confident_flow(flow, back, mask, relative=RELATIVE, absolute=ABSOLUTE)
    both = (ours[0] > 0) & (theirs[0] > 0)
    assert torch.equal(ours[:, both], theirs[:, both])
    assert (ours[0] != theirs[0]).float().mean() < 1e-3, "rounding of a sum decides only at the limit"
    assert both.any() == (min(size) > 1)


def test_not_a_number_has_no_confidence() -> None:
    flow = torch.full((4, 4, 2), float("nan"))
    maps = cpu_flow.confident_flow(flow, torch.zeros(4, 4, 2), None, relative=RELATIVE, absolute=ABSOLUTE)
    assert not maps.any()
