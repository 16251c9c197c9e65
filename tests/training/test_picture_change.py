# SPDX-License-Identifier: Apache-2.0
"""What two pictures of one camera tell, with no scene at hand."""

import numpy as np
import pytest
import torch

from rigs import arc_rig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import reference_backend
from structgstream.training.picture_change import PictureChange, detect_picture_changes
from structgstream.training.views import View, training_views

RIG = arc_rig(3)


def views(*, square_at: int | None = None) -> list[View]:
    """Noise, and in cam01 a white square at a column."""
    g = np.random.default_rng(0)
    images = {name: g.integers(0, 255, (32, 48, 3)).astype(np.uint8) for name in RIG}
    if square_at is not None:
        images["cam01"][10:20, square_at : square_at + 10] = 255
    return training_views(MultiViewFrame(0, 0.0, images), RIG, torch.device("cpu"))


def changes(now: list[View], before: list[View], *, reach_pixels: int = 0, flow_from: tuple[int, ...] = ()):
    return detect_picture_changes(
        now,
        before,
        threshold=0.1,
        reach_pixels=reach_pixels,
        scale=0.5,
        backend=reference_backend(),
        flow_from=flow_from,
    )


def test_pixels_that_changed_and_views_that_did_not() -> None:
    first, second = changes(views(square_at=5), views())
    assert (first.identical, second.identical) == (False, True)
    assert first.changed[11:19, 6:14].all(), "inside of the square"
    assert not first.changed[:, 17:].any()
    assert not second.changed.any()
    wide = changes(views(square_at=5), views(), reach_pixels=3)[0].changed
    assert wide.sum() > first.changed.sum()
    assert not wide[:, 20:].any()


def test_flow_is_looked_for_where_it_was_asked_for() -> None:
    now, before = views(square_at=8), views(square_at=4)
    indices = [view.index for view in now]
    found = changes(now, before, flow_from=(indices[1],))
    assert found[0].flow is None
    flow = found[1].flow
    assert flow is not None
    assert flow.shape == (16, 24, 6)
    torch.testing.assert_close(flow[..., 3:], before[1].reduced(0.5).colors)
    assert not flow.requires_grad


def test_views_without_their_like_are_an_error() -> None:
    with pytest.raises(ValueError, match="shorter"):
        changes(views(), views()[:1])
    assert changes([], []) == []
    assert PictureChange(torch.zeros(1, 1, dtype=torch.bool), True).flow is None
