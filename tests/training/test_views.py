# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator, Mapping
from itertools import islice

import numpy as np
import pytest
import torch

from structgstream.frames import MultiViewFrame
from structgstream.training.views import View, area_mean, coarse_to_fine, dilated, shuffled_views, training_views
from tests.support.rigs import arc_rig

RIG = arc_rig()


class Guarded(Mapping[str, np.ndarray]):
    """Pictures that refuse to be read for held-out cameras."""

    def __init__(self, held_out: frozenset[str]) -> None:
        self.held_out = held_out

    def __getitem__(self, name: str) -> np.ndarray:
        assert name not in self.held_out, f"{name} is held out"
        return np.full((32, 48, 3), 7, dtype=np.uint8)

    def __iter__(self) -> Iterator[str]:
        return iter(())

    def __len__(self) -> int:
        return 0


def test_held_out_pictures_are_never_read() -> None:
    rig = arc_rig()
    views = training_views(MultiViewFrame(0, 0.0, Guarded(rig.held_out)), rig, torch.device("cpu"))
    assert [view.index for view in views] == [0, 1, 2]


def test_every_view_comes_once_before_any_comes_twice() -> None:
    camera = arc_rig()["cam01"]
    views = [View(i, camera, torch.zeros(1)) for i in range(5)]
    order = shuffled_views(views, torch.Generator().manual_seed(3))
    seen = [next(order).index for _ in range(15)]
    for start in (0, 5, 10):
        assert sorted(seen[start : start + 5]) == [0, 1, 2, 3, 4]


def test_pictures_grow_stage_by_stage() -> None:
    camera = arc_rig()["cam01"]
    views = [View(i, camera, torch.zeros(32, 48, 3, dtype=torch.uint8)) for i in range(3)]
    drawn = coarse_to_fine(views, [(4, 0.25), (0, 0.5), (3, 0.75)], generator=torch.Generator().manual_seed(3))
    heights = [view.image.shape[0] for view in islice(drawn, 9)]
    assert heights == [8] * 4 + [24] * 3 + [32] * 2


def test_a_stage_without_pictures_draws_no_random_number() -> None:
    """So that fits without it are the same bits."""
    camera = arc_rig()["cam01"]
    views = [View(i, camera, torch.zeros(32, 48, 3, dtype=torch.uint8)) for i in range(7)]
    orders = [
        [view.index for view in islice(coarse_to_fine(views, stages, generator=torch.Generator().manual_seed(3)), 20)]
        for stages in ([(9, 0.5)], [(9, 0.5), (0, 0.7)])
    ]
    assert orders[0] == orders[1]


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.25, 0.7])
def test_reduced_bytes_are_averaged_as_torch_does_and_the_camera_is_the_same(scale: float) -> None:
    camera, generator = arc_rig()["cam01"], torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (32, 48, 3), generator=generator, dtype=torch.uint8)
    size = (round(32 * scale), round(48 * scale))
    expected = torch.nn.functional.interpolate(image.permute(2, 0, 1)[None].float(), size=size, mode="area")
    small = View(0, camera, image).reduced(scale)
    assert (small.image.dtype, small.image.shape) == (torch.uint8, (*size, 3))
    assert (small.image - expected[0].permute(1, 2, 0)).abs().max() <= 0.5 + 1e-4
    assert torch.allclose(small.camera.K[0], camera.K[0] * size[1] / 48)


@pytest.mark.parametrize("size", [(36, 64), (27, 48), (18, 32), (12, 64), (11, 47), (35, 63), (36, 7), (1, 1)])
def test_areas_are_averaged_as_torch_does(size: tuple[int, int]) -> None:
    planes = torch.rand(1, 3, 36, 64, generator=torch.Generator().manual_seed(1))
    expected = torch.nn.functional.interpolate(planes, size=size, mode="area")
    torch.testing.assert_close(area_mean(planes, size), expected, rtol=1e-6, atol=1e-6)


def test_absent_cameras_have_no_view_and_shift_no_index() -> None:
    images = {name: np.full((32, 48, 3), 10 * n, np.uint8) for n, name in enumerate(RIG) if name != "cam01"}
    masks = {"cam03": np.zeros((32, 48), bool)}
    views = training_views(MultiViewFrame(0, 0.0, images), RIG, torch.device("cpu"))
    assert [view.index for view in views] == [1, 2]
    assert [int(view.image[0, 0, 0]) for view in views] == [20, 30]
    (left,) = training_views(MultiViewFrame(0, 0.0, images, masks), RIG, torch.device("cpu"))
    assert left.index == 1


def test_views_of_arrays_that_count_backwards() -> None:
    """As from OpenCV's order of channels to red, green, blue."""
    stored = np.random.default_rng(0).integers(0, 256, (32, 48, 3), np.uint8)
    frame = MultiViewFrame(0, 0.0, {"cam02": stored[..., ::-1]}, {"cam02": (stored[..., 0] > 9)[::-1]})
    (view,) = training_views(frame, RIG, torch.device("cpu"))
    assert view.mask is not None
    np.testing.assert_array_equal(view.image.numpy(), np.where(view.mask.numpy()[..., None], stored[..., ::-1], 0))


def test_masked_pixels_are_black_and_reduce_to_pixels_that_do_not_count() -> None:
    mask = np.random.default_rng(0).random((32, 48)) > 0.1
    mask[:, 40:] = True
    frame = MultiViewFrame(0, 0.0, {"cam02": np.full((32, 48, 3), 200, np.uint8)}, {"cam02": mask})
    (view,) = training_views(frame, RIG, torch.device("cpu"))
    assert view.mask is not None
    assert not view.image[~view.mask].any()
    assert (view.image[view.mask] == 200).all()
    for scale in (0.5, 0.25, 0.4):
        small = view.reduced(scale)
        assert small.mask is not None
        assert not small.image[~small.mask].any()
        assert (small.image[small.mask] == 200).all()
        assert small.mask.any()
    half = view.reduced(0.5).mask
    assert half is not None
    assert torch.equal(half, view.mask.reshape(16, 2, 24, 2).all(3).all(1))
    frame = MultiViewFrame(0, 0.0, frame.images, {"cam02": np.ones((32, 48), bool)})
    assert training_views(frame, RIG, torch.device("cpu"))[0].mask is None


@pytest.mark.parametrize("reach", [0, 1, 2, 7])
@pytest.mark.parametrize("size", [(1, 1), (3, 20), (17, 5)])
def test_dilation_takes_the_largest_around_each_pixel(size: tuple[int, int], reach: int) -> None:
    values = torch.randn(2, *size, generator=torch.Generator().manual_seed(reach))
    expected = torch.nn.functional.max_pool2d(values, 2 * reach + 1, stride=1, padding=reach)
    assert torch.equal(dilated(values, reach), expected)
    assert torch.equal(dilated(values > 0.5, reach), expected > 0.5)
