# SPDX-License-Identifier: Apache-2.0
"""The pinhole that pictures of a lens are undistorted for."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole
from structgstream.data.source import resized, section, select_cameras
from structgstream.data.undistortion import (
    WIDEST_DEGREES,
    UndistortedSource,
    Undistortion,
    rectilinear,
    shows,
    undistort,
)
from structgstream.errors import CalibrationError, ConfigError
from structgstream.frames import MultiViewFrame
from tests.support.captures import small_rig
from tests.support.lens_cameras import LENSES, MILD, PINCUSHION, WIDE, filmed
from tests.support.memory_captures import MemoryCapture


def pattern(normalised: NDArray[np.float64]) -> NDArray[np.uint8]:
    """What the world looks like in a direction: smooth, and of a slope that shows shifts."""
    x, y = np.moveaxis(normalised, -1, 0)
    waves = np.stack([np.sin(5 * x), np.sin(5 * y), np.sin(3 * (x + y))], -1)
    return np.rint(127.5 + 120 * np.nan_to_num(waves)).astype(np.uint8)


def centers(camera: Camera) -> NDArray[np.float64]:
    columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    return np.stack(np.meshgrid(columns, rows), -1).astype(np.float64)


def expected(camera: Camera) -> NDArray[np.uint8]:
    return pattern(LensCamera(camera, Pinhole()).to_normalized(centers(camera)))


@pytest.mark.parametrize(("lens", "focal"), LENSES)
@pytest.mark.parametrize("degrees", [None, 60.0])
def test_the_pinhole_sees_what_is_there(lens: Lens, focal: float, degrees: float | None) -> None:
    """A picture taken through the lens, against the one that a pinhole takes: the mean error is that of rounding.

    Half a pixel of shift, the difference of the two conventions, would be 1.6 levels and more.
    """
    camera = filmed(lens, focal)
    taken = pattern(camera.to_normalized(centers(camera.camera)))
    target = rectilinear(camera, degrees=degrees)
    plan = Undistortion(camera, target)
    shown = np.ones((240, 320), bool) if plan.shown is None else plan.shown
    error = np.abs(plan(taken).astype(float) - expected(target))[shown]
    assert error.mean() < 0.35
    assert np.quantile(error, 0.999) < 3


def test_skew_is_undone() -> None:
    """Projection matrices and some calibrations have it; what is drawn has rectangular pixels."""
    camera = filmed(Pinhole(), 300.0)
    skewed = camera.camera.K.clone()
    skewed[0, 1] = 12.0
    camera = LensCamera(replace(camera.camera, K=skewed), Pinhole())
    target = rectilinear(camera)
    assert target.K[0, 1] == 0
    taken = pattern(camera.to_normalized(centers(camera.camera)))
    assert np.abs(Undistortion(camera, target)(taken).astype(float) - expected(target)).mean() < 0.35
    skewed[0, 1] = 1e-3
    assert rectilinear(LensCamera(replace(camera.camera, K=skewed), Pinhole())).K[0, 1] == 1e-3


@pytest.mark.parametrize(("lens", "focal"), LENSES)
@pytest.mark.parametrize("size", [(320, 240), (160, 160)])
def test_no_border_is_black_by_default(lens: Lens, focal: float, size: tuple[int, int]) -> None:
    camera = filmed(lens, focal)
    target = rectilinear(camera, size=size)
    assert (target.width, target.height) == size
    assert target.K[0, 0] == target.K[1, 1]
    assert Undistortion(camera, target).shown is None


def test_the_field_of_view_is_the_largest_without_a_border() -> None:
    """A little more would show one."""
    for lens, focal in LENSES[:3]:
        camera = filmed(lens, focal)
        target = rectilinear(camera)
        wider = replace(target, K=target.K * torch.tensor([[0.97, 1, 1], [1, 0.97, 1], [1, 1, 1]]))
        assert Undistortion(camera, wider).shown is not None


def test_a_wide_view_shows_the_lens_where_it_reaches() -> None:
    camera = filmed(Fisheye(), 640 / math.radians(150))
    shown = Undistortion(camera, rectilinear(camera, degrees=140)).shown
    assert shown is not None  # the picture is less high than wide
    assert shown[120].all()


def test_what_the_lens_does_not_show_is_black_and_masked() -> None:
    camera = filmed(Fisheye(), 640 / math.radians(90))
    plan = Undistortion(camera, rectilinear(camera, degrees=110))
    white = np.full((240, 320, 3), 255, np.uint8)
    result = plan(white)
    assert plan.shown is not None
    assert 0.4 < plan.shown.mean() < 0.9
    assert (result[plan.shown] == 255).all()
    assert (result[~plan.shown] == 0).all()
    assert plan.shown[120, 160]
    assert not plan.shown[0, 0]


@pytest.mark.parametrize("lens", [MILD, Fisheye()])
def test_areas_are_averaged_where_pictures_shrink(lens: Lens) -> None:
    """Stripes of one pixel become grey; single samples of them would be black or white."""
    camera = filmed(lens, 500)
    stripes = np.zeros((240, 320, 3), np.uint8)
    stripes[:, ::2] = 255
    small = Undistortion(camera, rectilinear(camera, size=(80, 60)))(stripes)
    assert small.shape == (60, 80, 3)
    assert abs(float(small.mean()) - 127.5) < 2
    assert small.std() < 25


RIG = small_rig(4)
CAMERAS = {
    name: replace(filmed(lens), camera=replace(filmed(lens).camera, viewmat=RIG[name].viewmat, near=0.3))
    for name, lens in zip(RIG, (MILD, Pinhole(), WIDE, PINCUSHION))
}


@pytest.fixture(scope="module")
def source() -> MemoryCapture:
    """Two frames of the pattern through the lenses of :data:`CAMERAS`; the second is darker."""
    rig = CameraRig({name: own.camera for name, own in CAMERAS.items()}, frozenset({"cam00"}))
    taken = {name: pattern(own.to_normalized(centers(own.camera))) for name, own in CAMERAS.items()}
    darker = {name: image // np.uint8(2) for name, image in taken.items()}
    return MemoryCapture(rig, [MultiViewFrame(0, 0.0, taken), MultiViewFrame(1, 1 / 30, darker)], name="take")


def test_a_capture_of_lenses_becomes_one_of_pinholes(source: MemoryCapture) -> None:
    made = undistort(source, CAMERAS)
    assert isinstance(made, UndistortedSource)
    assert made.rig.testing == ("cam00",)
    assert (made.name, made.fps, len(made)) == ("take", 30.0, 2)
    assert {camera.near for camera in made.rig.cameras.values()} == {0.3}
    taken = list(source.frames())
    wanted = {name: expected(camera) for name, camera in made.rig.cameras.items()}
    for frame, before in zip(made.frames(), taken, strict=True):
        assert (frame.index, frame.pts_seconds) == (before.index, before.pts_seconds)
        assert frame.images["cam01"] is not None
        np.testing.assert_array_equal(frame.images["cam01"], before.images["cam01"])
        for name in made.rig:
            error = np.abs(frame.images[name].astype(float) - wanted[name] // (frame.index + 1))
            assert error.mean() < 1
            assert torch.equal(made.rig[name].viewmat, source.rig[name].viewmat)
    assert made.plans["cam00"].shown is None  # type: ignore[union-attr]
    assert [frame.index for frame in made.frames(1)] == [1]


def test_a_capture_of_pinholes_is_left_alone(source: MemoryCapture) -> None:
    assert undistort(source, {name: replace(own, lens=Pinhole()) for name, own in CAMERAS.items()}) is source


def test_a_smaller_picture_is_resampled_once(source: MemoryCapture) -> None:
    half = section(resized(undistort(source, CAMERAS), 0.5), start=1)
    (frame,) = half.frames()
    for name in half.rig:
        camera = half.rig[name]
        assert frame.images[name].shape == (120, 160, 3) == (camera.height, camera.width, 3)
        error = np.abs(frame.images[name].astype(float) - expected(camera) // 2)
        assert error.mean() < 1


def test_some_of_the_cameras(source: MemoryCapture) -> None:
    part = select_cameras(undistort(source, CAMERAS), ("cam02", "cam03"))
    assert [*part.rig] == ["cam02", "cam03"]
    whole = next(undistort(source, CAMERAS).frames())
    for name, image in next(part.frames()).images.items():
        np.testing.assert_array_equal(image, whole.images[name])


def test_a_broken_lens_names_its_camera(source: MemoryCapture) -> None:
    broken = CAMERAS["cam02"]
    K = broken.camera.K.clone()
    K[1, 2] = -10
    cameras = {**CAMERAS, "cam02": replace(broken, camera=replace(broken.camera, K=K))}
    with pytest.raises(CalibrationError, match="Camera 'cam02' of take"):
        undistort(source, cameras)


def test_a_wide_fisheye_stops_at_the_widest_that_a_plane_shows_well() -> None:
    camera = filmed(Fisheye(), 640 / math.radians(150), width=640, height=480)
    target = rectilinear(camera)
    assert math.degrees(2 * math.atan(320 / float(target.K[0, 0]))) == pytest.approx(WIDEST_DEGREES)
    wide = rectilinear(camera, degrees=140)
    assert float(wide.K[0, 0]) == pytest.approx(320 / math.tan(math.radians(70)))


def test_a_lens_shows_what_its_picture_holds() -> None:
    camera = filmed(Pinhole(), 400.0, width=640, height=480)
    centers = np.array([[0.5, 0.5], [639.5, 479.5], [320.0, 240.0], [0.4, 240.0], [320.0, 480.0]])
    assert shows(camera, camera.to_normalized(centers)).tolist() == [True, True, True, False, False]
    assert not shows(filmed(MILD), np.array([[50.0, 0.0]]))[0], "beyond where the model can be inverted"


def test_a_pinhole_stays_as_it_is() -> None:
    camera = filmed(Pinhole())
    assert rectilinear(camera) is not camera.camera
    assert torch.equal(rectilinear(camera).K, camera.camera.K)
    half = rectilinear(camera, size=(160, 120))
    assert torch.equal(half.K, camera.camera.resized(160, 120).K)


def test_what_cannot_be_made_is_refused() -> None:
    with pytest.raises(ConfigError, match="cannot show 180 degrees"):
        rectilinear(filmed(WIDE), degrees=180)
    with pytest.raises(ConfigError, match="0x10 pixels"):
        rectilinear(filmed(WIDE), size=(0, 10))
    off = filmed(MILD)
    K = off.camera.K.clone()
    K[0, 2] = -40
    with pytest.raises(CalibrationError, match="belong to another picture"):
        rectilinear(replace(off, camera=replace(off.camera, K=K)))
