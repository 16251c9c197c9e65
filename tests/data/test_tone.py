# SPDX-License-Identifier: Apache-2.0
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from captures import write_clip, write_panoptic
from properties import examples
from structgstream.cameras import Camera
from structgstream.data.json_videos import open_json_videos
from structgstream.data.lenses import LensCamera, opencv_lens
from structgstream.data.panoptic import open_panoptic
from structgstream.data.source import FrameSource
from structgstream.data.tone import IDENTITY, ToneCurve, toned
from structgstream.data.undistortion import undistort
from structgstream.data.wrappers import SourceWrapper, resized, section, select_cameras
from structgstream.errors import CalibrationError
from structgstream.frames import MultiViewFrame


def gamma(exponent: float) -> ToneCurve:
    """A curve near ``x ** exponent``, the same for all channels."""
    return ToneCurve((tuple(IDENTITY**exponent),) * 3)


def darker(gain: float) -> ToneCurve:
    return ToneCurve((tuple(gain * IDENTITY),) * 3)


def test_the_identity_changes_nothing() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
    assert ToneCurve.identity().is_identity
    np.testing.assert_array_equal(ToneCurve.identity().apply(picture), picture)


@examples(100)
@given(gain=st.floats(0.1, 0.9), bias=st.floats(0, 0.1))
def test_controls_of_a_gain_and_a_bias_are_that(gain: float, bias: float) -> None:
    colors = np.linspace(0, 1, 30).reshape(10, 3)
    curve = ToneCurve((tuple(gain * IDENTITY + bias),) * 3)
    np.testing.assert_allclose(curve(colors), gain * colors + bias, atol=1e-12)


@examples(100)
@example([0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5])
@given(st.lists(st.floats(-0.2, 1.2), min_size=8, max_size=8).map(sorted))
def test_controls_that_do_not_fall_give_a_table_that_does_not(controls: list[float]) -> None:
    assert (np.diff(ToneCurve((tuple(controls),) * 3).table.astype(int), axis=0) >= 0).all()


def test_each_channel_has_its_own_curve() -> None:
    curve = ToneCurve((tuple(IDENTITY), tuple(0.5 * IDENTITY), tuple(IDENTITY + 0.2)))
    picture = np.full((2, 3, 3), (100, 100, 250), np.uint8)
    np.testing.assert_array_equal(curve.apply(picture)[1, 2], (100, 50, 255))


def test_a_curve_goes_through_json() -> None:
    curve = gamma(0.8)
    assert ToneCurve(json.loads(json.dumps(curve.controls))) == curve


@pytest.mark.parametrize(
    "controls",
    [
        (),
        ((0.0, 1.0),) * 3,
        ((*IDENTITY[:-1], float("nan")),) * 3,
        (tuple(IDENTITY[::-1]),) * 3,
        (("a",) * 8,) * 3,
        ((0.0,), (0.0, 1.0), (1.0,)),
    ],
)
def test_what_is_no_curve_is_refused(controls: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(CalibrationError, match="needs 8 finite numbers that do not fall"):
        ToneCurve(controls)


@pytest.fixture(params=["pictures", "videos"])
def source(request: pytest.FixtureRequest, tmp_path: Path) -> FrameSource:
    if request.param == "pictures":
        write_panoptic(tmp_path, frames=4)
        return open_panoptic(tmp_path)
    write_clip(tmp_path)
    return open_json_videos(tmp_path)


def test_pictures_are_toned_by_camera(source: FrameSource) -> None:
    first, second, *_ = source.rig
    plain = next(source.frames(2))
    frame = next(toned(source, {first: darker(0.5), second: ToneCurve.identity()}).frames(2))
    assert (frame.index, frame.pts_seconds, list(frame.images)) == (2, plain.pts_seconds, list(plain.images))
    np.testing.assert_allclose(frame.images[first], plain.images[first] / 2, atol=0.51)
    np.testing.assert_array_equal(frame.images[second], plain.images[second])


def test_curves_that_change_nothing_are_left_away(source: FrameSource) -> None:
    assert toned(source, {}) is source
    assert toned(source, {next(iter(source.rig)): ToneCurve.identity()}) is source


def test_a_curve_of_an_unknown_camera_is_refused(source: FrameSource) -> None:
    with pytest.raises(CalibrationError, match="'nobody'"):
        toned(source, {"nobody": darker(0.5)})


def test_curves_compose_with_sizes_sections_and_choices(source: FrameSource) -> None:
    names = list(source.rig)[:2]
    curves = {name: darker(0.5) for name in source.rig}
    made = section(resized(select_cameras(toned(source, curves), tuple(names)), 0.5), start=1, frames=2)
    plain = section(resized(select_cameras(source, tuple(names)), 0.5), start=1, frames=2)
    assert list(made.rig) == names
    for frame, other in zip(made.frames(), plain.frames(), strict=True):
        assert frame.index == other.index
        for name in names:
            np.testing.assert_allclose(frame.images[name], other.images[name] / 2, atol=0.51)


def test_absent_cameras_stay_absent_and_masks_stay(source: FrameSource) -> None:
    gone, masked, *_ = source.rig
    mask = np.zeros((48, 64), np.bool_)

    class Partial(SourceWrapper):
        def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
            for frame in self.source.frames(start):
                there = {name: image for name, image in frame.images.items() if name != gone}
                yield replace(frame, images=there, masks={masked: mask})

    frame = next(toned(Partial(source), {name: darker(0.5) for name in source.rig}).frames())
    assert set(frame.images) == set(source.rig) - {gone}
    assert frame.masks[masked] is mask


def test_lenses_are_undistorted_after_the_curves_and_their_borders_stay_black(source: FrameSource) -> None:
    curves = {name: ToneCurve((tuple(0.5 * IDENTITY + 0.3),) * 3) for name in source.rig}
    filmed = {name: LensCamera(source.rig[name], opencv_lens((-0.3, 0.0, 0.0, 0.0))) for name in source.rig}

    def wide(own: LensCamera) -> Camera:
        K = own.camera.K * torch.tensor([[0.4], [0.4], [1.0]], dtype=torch.float64)
        K[:2, 2] = torch.tensor([own.camera.width / 2, own.camera.height / 2])
        return replace(own.camera, K=K)

    frame = next(undistort(toned(source, curves), filmed, target=wide).frames())
    for image in frame.images.values():
        assert image[0, 0].tolist() == [0, 0, 0]
        assert image[image.shape[0] // 2, image.shape[1] // 2].min() > 70
