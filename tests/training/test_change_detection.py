# SPDX-License-Identifier: Apache-2.0
"""Changes between two pictures of a camera, without a scene."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import reference_backend
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.preprocess import detect_changes
from structgstream.training.views import View, blackened, training_views
from tests.support.rigs import arc_rig
from tests.support.varied import varied

RIG = arc_rig(3)


def views(*, square_at: int | None = None) -> list[View]:
    """Noise, and in cam01 a white square at a column."""
    g = np.random.default_rng(0)
    images = {name: g.integers(0, 255, (32, 48, 3)).astype(np.uint8) for name in RIG}
    if square_at is not None:
        images["cam01"][10:20, square_at : square_at + 10] = 255
    return training_views(MultiViewFrame(0, 0.0, images), RIG, torch.device("cpu"))


def changes(
    now: list[View], before: list[View], *, reach_pixels: int = 0, flow_from: tuple[int, ...] = ()
) -> list[Any]:
    return detect_changes(
        now,
        before,
        config=varied(MotionConfig(picture_scale=0.5), REACH_PIXELS=reach_pixels, CHANGE_THRESHOLD=0.1),
        backend=reference_backend(),
        flow_from=flow_from,
    )


def test_pixels_that_changed_and_views_that_did_not() -> None:
    first, second = changes(views(square_at=5), views())
    assert (first.repeated, second.repeated) == (False, True)
    assert first.changed[11:19, 6:14].all(), "inside of the square"
    assert not first.changed[:, 17:].any()
    assert not second.changed.any()
    wide = changes(views(square_at=5), views(), reach_pixels=3)[0].changed
    assert wide.sum() > first.changed.sum()
    assert not wide[:, 20:].any()


def test_a_frozen_picture_that_is_encoded_again_is_repeated_and_a_noisy_one_is_not() -> None:
    before = views()
    g = torch.Generator().manual_seed(0)

    def disturbed(share: float, levels: int) -> list[View]:
        """Every picture with a share of its values further from the middle, or nearer to it, by some levels."""
        chosen = (torch.rand(before[0].image.shape, generator=g) < share).int() * levels
        image = [view.image.int() + torch.where(view.image > 127, -chosen, chosen) for view in before]
        return [replace(view, image=shown.to(torch.uint8)) for view, shown in zip(before, image)]

    assert all(change.repeated for change in changes(disturbed(0.05, 3), before))
    noisy = changes(disturbed(0.5, 3), before)
    assert not any(change.repeated or change.changed.any() for change in noisy)


class LargestNumbers(TorchDispatchMode):
    """Notes the largest array of whole numbers that an operation gives."""

    numbers = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        if isinstance(found, torch.Tensor) and found.dtype == torch.int32:
            self.numbers = max(self.numbers, found.numel())
        return found


def test_still_pictures_are_compared_one_at_a_time_on_the_processor() -> None:
    """Twenty of 1352 x 1014 pixels took a gigabyte together."""
    backend = reference_backend().with_functions(
        changed_pixels=lambda then, now, **rules: torch.zeros(now.shape[:-1], dtype=torch.bool)
    )
    with LargestNumbers() as largest:
        found = detect_changes(views(), views(), config=MotionConfig(), backend=backend)
    assert all(change is not None and change.repeated for change in found)
    assert largest.numbers == 32 * 48 * 3


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


def test_a_camera_is_compared_with_itself_or_not_at_all() -> None:
    """A missing picture shifts no other camera's."""
    both, alone = views(square_at=5), views()[1:]
    first, second = changes(both, alone)
    assert first is None
    assert second.repeated
    (only,) = changes(both[:1], views())
    assert only.changed.any()
    assert changes(both[1:], views()[:1]) == [None]


def test_what_either_picture_leaves_out_has_not_changed_and_has_no_flow() -> None:
    now, before = views(square_at=8), views(square_at=4)
    mask = torch.ones(32, 48, dtype=torch.bool)
    mask[:, 10:] = False  # changes of columns 4 to 7 reach beyond it
    whole = changes(now, before, flow_from=(0,))[0]
    for pair in ((mask, None), (None, mask), (mask, mask)):
        masked = [
            [replace(own[0], image=blackened(own[0].image, part), mask=part), *own[1:]]
            for own, part in zip((now, before), pair, strict=True)
        ]
        found = changes(*masked, reach_pixels=3, flow_from=(0,))[0]
        assert not found.changed[:, 10:].any()
        assert found.changed[:, :10].any()
        assert not found.flow[:, 5:, :3].any()
    assert whole.changed[:, 10:].any()
    assert whole.flow[:, 5:, :3].any()
