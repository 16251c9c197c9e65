# SPDX-License-Identifier: Apache-2.0
"""Pictures that a calibration is made from, checked."""

import numpy as np
import pytest

from structgstream.errors import CalibrationError, CaptureError
from structgstream.preparation.calibration.pictures import checked_pictures
from tests.support.filmed import ring


def shots(count: int, *, size: tuple[int, int] = (48, 64)) -> list[np.ndarray]:
    return [np.zeros((*size, 3), np.uint8)] * count


def mask(*size: int) -> np.ndarray:
    return np.ones(size, bool)


def test_what_fits() -> None:
    checked_pictures({"a": shots(2), "b": shots(2, size=(30, 40))})
    checked_pictures({"a": shots(2)}, {"a": [mask(48, 64)] * 2})
    checked_pictures({"a": shots(1), "b": shots(1)}, {"b": []})
    rig = ring(2, radius=2.0, arc_degrees=40)
    size = rig["cam00"].camera.height, rig["cam00"].camera.width
    checked_pictures({name: shots(1, size=size) for name in rig}, cameras=rig)


@pytest.mark.parametrize(
    ("counts", "told"), [({"a": 2, "b": 1}, "'a' 2, 'b' 1"), ({"a": 0, "b": 0}, "'a' 0, 'b' 0"), ({}, "got: none")]
)
def test_all_have_the_same_instants(counts: dict[str, int], told: str) -> None:
    with pytest.raises(CaptureError, match=f"pictures of the same instants; got: .*{told}|{told}"):
        checked_pictures({name: shots(count) for name, count in counts.items()})


def test_one_size_a_camera() -> None:
    with pytest.raises(CalibrationError, match="'b' have 64x48 and 64x50 pixels; expected one"):
        checked_pictures({"a": shots(2), "b": [*shots(1), *shots(1, size=(50, 64))]})


@pytest.mark.parametrize("masks", [[mask(48, 64)], [mask(48, 64), mask(64, 48)]])
def test_masks_fit_their_pictures(masks: list[np.ndarray]) -> None:
    with pytest.raises(CaptureError, match="masks of camera 'a' do not fit its pictures; expected 2 of 64x48"):
        checked_pictures({"a": shots(2)}, {"a": masks})


def test_calibrated_cameras_have_pictures_of_their_size() -> None:
    rig = ring(2, radius=2.0, arc_degrees=40)
    width, height = rig["cam00"].camera.width, rig["cam00"].camera.height
    with pytest.raises(CaptureError, match="no pictures of camera 'cam01', which is calibrated"):
        checked_pictures({"cam00": shots(1, size=(height, width))}, cameras=rig)
    with pytest.raises(CalibrationError, match=f"{height}x{width} pixels, its calibration is for {width}x{height}"):
        checked_pictures({name: shots(1, size=(width, height)) for name in rig}, cameras=rig)
