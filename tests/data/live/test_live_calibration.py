# SPDX-License-Identifier: Apache-2.0
"""Lenses, masks and sizes of a calibration on pictures that arrive."""

from pathlib import Path

import numpy as np
import pytest

from structgstream.data.dataset_layouts import bundled_clip, bundled_clip_path
from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.data.live.source import LiveOptions, LiveSource, read_calibration
from structgstream.data.prepared import PreparedCamera, PreparedCapture, filmed_rig, write_prepared
from structgstream.data.undistortion import Undistortion
from structgstream.frames import MultiViewFrame
from tests.support.captures import small_rig


def prepared(folder: Path) -> PreparedCapture:
    """A prepared capture of one lens that distorts, whose videos are not there."""
    rig = small_rig()
    lens = RadialTangential(k1=-0.15)
    cameras = {
        name: PreparedCamera(
            f"{name}.mp4", LensCamera(rig[name], lens if number == 1 else RadialTangential()), rig[name]
        )
        for number, name in enumerate(rig)
    }
    capture = PreparedCapture(cameras, 25.0, 0.1, held_out=frozenset([next(iter(rig))]))
    write_prepared(folder, capture)
    return capture


def test_pictures_are_undistorted_as_those_of_the_capture(tmp_path: Path) -> None:
    capture, path = prepared(tmp_path), tmp_path / "rig.toml"
    filmed = filmed_rig(tmp_path, capture)
    path.write_text('calibration = "."\n' + "".join(f'[cameras.{name}]\nurl = "udp://{name}"\n' for name in filmed))
    random = np.random.default_rng(0)
    images = {
        name: random.integers(0, 256, (camera.height, camera.width, 3)).astype(np.uint8)
        for name, camera in filmed.cameras.items()
    }
    frames = [MultiViewFrame(0, 3.25, images, captured_unix_seconds=5.0)]
    source = LiveSource(path, tmp_path / "x.sgs", LiveOptions(near=0.3))
    (frame,) = source._calibrated(iter(frames)).frames()
    second = [*images][1]
    expected = Undistortion(capture.cameras[second].filmed, capture.cameras[second].pinhole)(images[second])
    assert (frame.images[second] == expected).all()
    assert (expected != images[second]).any()
    assert (frame.pts_seconds, frame.captured_unix_seconds) == (3.25, 5.0)
    assert source.rig[second].near == 0.3
    half = LiveSource(path, tmp_path / "x.sgs", LiveOptions(held_out=(second,), scale=0.5))
    assert half.rig.testing == (second,)
    (small,) = half._calibrated(iter(frames)).frames()
    assert small.images[second].shape == (half.rig[second].height, half.rig[second].width, 3)
    assert half.rig[second].width == round(filmed[second].width / 2)


def test_a_capture_of_another_layout_gives_its_rig() -> None:
    capture = read_calibration(bundled_clip_path())
    clip = bundled_clip()
    assert capture.held_out == clip.rig.held_out
    assert capture.near == pytest.approx(clip.rig["cam03"].near)
    chosen = capture.only(["cam02", "cam01", "cam05"])
    assert [*chosen.cameras] == ["cam01", "cam02", "cam05"]
    assert chosen.held_out == frozenset()
    rig = filmed_rig(bundled_clip_path(), capture)
    assert (rig["cam03"].K == clip.rig["cam03"].K).all()
    assert (rig["cam03"].viewmat == clip.rig["cam03"].viewmat).all()
