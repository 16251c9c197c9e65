# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from structgstream.cameras import CameraRig, Similarity, check_rig, normalizing_similarity, rig_radius
from structgstream.errors import CalibrationError
from tests.support.rigs import arc_rig


def test_center_is_where_the_camera_stands() -> None:
    rig = arc_rig(3, radius=3.0)
    assert torch.allclose(rig["cam01"].center, torch.tensor([0.0, -0.3, -3.0], dtype=torch.float64))


def test_resizing_keeps_rays() -> None:
    camera = arc_rig()["cam01"]
    small = camera.resized(24, 8)
    point = torch.tensor([0.2, 0.1, 2.0], dtype=torch.float64)
    large_pixel, small_pixel = camera.K @ point, small.K @ point
    ratio = torch.tensor([24 / 48, 8 / 32], dtype=torch.float64)
    assert torch.allclose(small_pixel[:2] / small_pixel[2], large_pixel[:2] / large_pixel[2] * ratio)
    assert (small.width, small.height) == (24, 8)


def edited(matrix: torch.Tensor, row: int, column: int, value: float) -> torch.Tensor:
    changed = matrix.clone()
    changed[row, column] = value
    return changed


def test_what_is_no_pinhole_camera_is_refused() -> None:
    camera = arc_rig()["cam01"]
    wishes: list[tuple[dict[str, Any], str]] = [
        ({"K": edited(camera.K, 0, 2, math.nan)}, "not finite"),
        ({"viewmat": 2.0 * camera.viewmat}, "orthonormal"),
        ({"viewmat": -camera.viewmat}, "orthonormal"),
        ({"K": torch.diag(torch.tensor([0.0, 1.0, 1.0]))}, "positive"),
        ({"width": 48.0}, r"whole pixels, got 48\.0x32"),
    ]
    for wrong, words in wishes:
        with pytest.raises(CalibrationError, match=words):
            replace(camera, **wrong)


def test_rig_order_and_held_out_sets() -> None:
    rig = arc_rig(4)
    assert rig.training == ("cam01", "cam02", "cam03")
    assert rig.testing == ("cam00",)
    assert rig.with_held_out(frozenset({"cam02"})).training == ("cam00", "cam01", "cam03")
    with pytest.raises(CalibrationError, match="cam99"):
        rig.with_held_out(frozenset({"cam99"}))


def test_one_training_camera_is_not_enough() -> None:
    with pytest.raises(CalibrationError, match="at least two training cameras"):
        CameraRig({"a": arc_rig()["cam01"], "b": arc_rig()["cam02"]}, held_out=frozenset({"a"}))


def test_rigs_and_cameras_of_other_types() -> None:
    cameras = arc_rig().cameras
    held: Any = ["cam00"]  # a list is as good
    assert CameraRig(cameras, held).testing == ("cam00",)
    for given, held, words in (([*cameras.values()], (), "by name"), (cameras, "cam00", r"as \('cam00',\)")):
        wrong: Any = given
        with pytest.raises(CalibrationError, match=words):
            CameraRig(wrong, held)


def test_cameras_that_cannot_be_drawn_as_they_are_calibrated_are_refused() -> None:
    rig = arc_rig()
    check_rig(rig)
    camera = rig["cam01"]
    for wrong, words in (
        (replace(camera, viewmat=edited(camera.viewmat, 3, 2, 3.0)), "last row of the view matrix is .* transpose"),
        (replace(camera, K=edited(camera.K, 2, 0, 24.0)), "last row of the K is"),
        (replace(camera, K=edited(camera.K, 0, 1, 2.0)), "first two rows are .* calibrate without skew"),
        (replace(camera, near=0.0), "near plane must be positive, got 0"),
    ):
        with pytest.raises(CalibrationError, match=f"^(Camera 'cam01').*{words}"):
            check_rig(rig.mapped({**rig.cameras, "cam01": wrong}))
    check_rig(rig.mapped({**rig.cameras, "cam01": replace(camera, K=edited(camera.K, 0, 1, 1e-3))}))


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (5e5, 5.4e6, 300.0)])
def test_cameras_at_one_place_see_no_depth(place: tuple[float, float, float]) -> None:
    rig, center = arc_rig(), torch.tensor(place, dtype=torch.float64)
    for shift, refused in ((0.0, True), (0.1, False)):
        turned = {}
        for number, name in enumerate(rig):
            viewmat = rig[name].viewmat.clone()
            viewmat[:3, 3] = -viewmat[:3, :3] @ (center + shift * number)
            turned[name] = replace(rig[name], viewmat=viewmat)
        if refused:
            with pytest.raises(CalibrationError, match="All 3 cameras stand at one place"):
                check_rig(rig.mapped(turned))
        else:
            check_rig(rig.mapped(turned))


def pixel(camera, point):
    p = camera.K @ (camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3])
    return p[:2] / p[2]


def test_normalised_cameras_see_normalised_points_in_the_same_pixels() -> None:
    rig = arc_rig()
    similarity = Similarity(center=(0.5, -1.0, 2.0), scale=0.3)
    point = torch.tensor([0.3, 0.2, 0.4], dtype=torch.float64)
    for name in rig:
        assert torch.allclose(pixel(rig[name], point), pixel(similarity.camera(rig[name]), similarity.points(point)))


def test_inverse_gives_the_captures_units_back() -> None:
    similarity = Similarity(center=(0.5, -1.0, 2.0), scale=0.3)
    points = torch.randn(7, 3, dtype=torch.float64)
    assert torch.allclose(similarity.inverse_points(similarity.points(points)), points)


def test_every_rig_comes_to_the_same_radius() -> None:
    for radius in (0.4, 50.0):
        rig = arc_rig(radius=radius)
        normalised = normalizing_similarity(rig, radius=1.0).rig(rig)
        assert abs(rig_radius(normalised) - 1.0) < 1e-9
        assert normalised["cam01"].near == rig["cam01"].near / rig_radius(rig)


def test_held_out_cameras_do_not_move_the_scene() -> None:
    rig = arc_rig(5)
    with_other_held_out = rig.mapped({**rig.cameras, "cam00": rig["cam03"]})
    assert normalizing_similarity(rig, radius=1.0) == normalizing_similarity(with_other_held_out, radius=1.0)
