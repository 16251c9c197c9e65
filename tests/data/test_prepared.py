# SPDX-License-Identifier: Apache-2.0
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.data.lenses import Fisheye, LensCamera, Pinhole, RadialTangential
from structgstream.data.open import open_capture
from structgstream.data.prepared import (
    FILE,
    PreparedCamera,
    PreparedCapture,
    open_prepared,
    read_prepared,
    write_prepared,
)
from structgstream.data.source import apart_seconds
from structgstream.data.timeline import Clock
from structgstream.data.undistortion import rectilinear
from structgstream.errors import CalibrationError, CaptureError
from tests.support.captures import (
    all_numbers,
    edit_json,
    small_rig,
    write_pictures,
    write_videos,
)

LENSES = (Pinhole(), RadialTangential(k1=-0.1, k2=0.02, p1=0.001), Fisheye(k1=0.02), Pinhole())


def content(
    *, suffix: str = ".mp4", folder: str = "videos", lenses: tuple[Any, ...] = (Pinhole(),) * 4
) -> PreparedCapture:
    cameras = {}
    for (name, camera), lens in zip(small_rig().cameras.items(), lenses, strict=True):
        filmed = LensCamera(camera, lens)
        cameras[name] = PreparedCamera(f"{folder}/{name}{suffix}", filmed, rectilinear(filmed))
    return PreparedCapture(cameras, 30.0, 0.25, "metres", frozenset({"cam01"}))


def test_what_is_written_is_read(tmp_path: Path) -> None:
    wanted = content(lenses=LENSES)
    first = wanted.cameras["cam00"]
    cameras = {**wanted.cameras, "cam00": replace(first, clock=Clock(-1.25, 1.00001))}
    wanted = replace(wanted, cameras=cameras, points="points.npy")
    write_prepared(tmp_path, wanted)
    found = read_prepared(tmp_path)
    assert (found.fps, found.near, found.unit, found.held_out) == (30.0, 0.25, "metres", frozenset({"cam01"}))
    assert found.points == "points.npy"
    for name, camera in wanted.cameras.items():
        read = found.cameras[name]
        assert (read.files, read.clock, read.filmed.lens) == (camera.files, camera.clock, camera.filmed.lens)
        for one, other in ((read.filmed.camera, camera.filmed.camera), (read.pinhole, camera.pinhole)):
            assert torch.equal(one.K, other.K)
            assert torch.equal(one.viewmat, other.viewmat)
            assert (one.width, one.height) == (other.width, other.height)


def test_lenses_are_undistorted_to_the_stated_pinhole(tmp_path: Path) -> None:
    capture = content(lenses=(RadialTangential(k1=-0.1),) * 4)
    cameras = {
        name: replace(camera, pinhole=rectilinear(camera.filmed, degrees=50.0, size=(40, 30)))
        for name, camera in capture.cameras.items()
    }
    write_videos(tmp_path / "videos", list(cameras), frames=2)
    write_prepared(tmp_path, replace(capture, cameras=cameras))
    source = open_capture(tmp_path)
    frame = next(source.frames(0))
    assert {image.shape for image in frame.images.values()} == {(30, 40, 3)}
    assert source.rig["cam03"].K[0, 0] == pytest.approx(20 / np.tan(np.radians(25)))
    assert source.rig.testing == ("cam01",)


@pytest.mark.parametrize("folder", ["videos", "pictures"])
def test_pictures_and_videos_are_paired_alike(tmp_path: Path, folder: str) -> None:
    """Four cameras of one trigger whose times lie around half a period, and one of them is slower by a tenth."""
    capture = content(folder=folder, suffix="" if folder == "pictures" else ".mp4")
    clocks = [Clock(12.35 + jitter, rate) for jitter, rate in ((2e-4, 1), (-1e-4, 1), (1e-4, 1), (-2e-4, 1.1))]
    cameras = {
        name: replace(camera, clock=clock)
        for (name, camera), clock in zip(capture.cameras.items(), clocks, strict=True)
    }
    if folder == "videos":
        write_videos(tmp_path / folder, list(cameras), frames=12)
    else:
        write_pictures(tmp_path / folder, "CAM/FRAME.png", cameras, frames=12)
    write_prepared(tmp_path, replace(capture, cameras=cameras, held_out=frozenset()))
    source = open_capture(tmp_path)
    assert source.rig["cam00"].near == 0.25
    paired = [[frame for _, frame in own] for own in all_numbers(source.frames(0))]
    assert paired == [[n] * 4 for n in range(6)] + [[6] * 3] + [[n, n, n, n - 1] for n in range(7, 12)]
    apart = apart_seconds(source)
    assert apart["cam03"][4] - apart["cam00"][4] == pytest.approx(4 * 0.1 / 30 - 4e-4)


def test_points_come_along_unless_another_camera_is_held_out(tmp_path: Path) -> None:
    capture = replace(content(), points="points.npy")
    write_videos(tmp_path / "videos", list(capture.cameras), frames=2)
    points = np.random.default_rng(0).normal(size=(9, 3))
    np.save(tmp_path / "points.npy", points)
    write_prepared(tmp_path, capture)
    assert np.array_equal(open_capture(tmp_path).points, points)  # type: ignore[arg-type]
    assert np.array_equal(open_capture(tmp_path, held_out=()).points, points)  # type: ignore[arg-type]
    assert open_capture(tmp_path, held_out=("cam02",)).points is None
    assert open_capture(tmp_path, held_out=("cam02",), scale=0.5).points is None


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (lambda values: values["cameras"]["cam02"].pop("K"), r"Camera 'cam02' of .*capture\.json cannot be read"),
        (lambda values: values["cameras"]["cam02"]["lens"].update(model="soft"), r"Camera 'cam02' .*soft"),
        (lambda values: values["cameras"]["cam02"]["lens"].update(k9=1), r"Camera 'cam02' .*k9"),
        (lambda values: values["cameras"]["cam02"].update(size=[9, 9]), r"Camera 'cam02' .*principal point"),
        (lambda values: values.update(unit="yards"), r"capture\.json cannot be read .*yards"),
        (lambda values: values.pop("fps"), r"capture\.json cannot be read \(.*fps"),
        (lambda values: values.update(fps=0), r"capture\.json cannot be read \(.*fps 0\)"),
        (lambda values: values.update(fps=math.nan), r"capture\.json cannot be read \(fps: .*nan\)"),
        (lambda values: values.update(near=-1), r"capture\.json cannot be read \(.*near -1\)"),
        (lambda values: values.update(version=2), r"version 2; .*reads .*version 1: prepare the capture again"),
        # Also where a live rig takes some of the cameras only.
        (lambda values: values.update(held_out=["nobody"]), r"capture\.json holds out camera 'nobody', .*are cam00, "),
        (lambda values: values["cameras"]["cam02"]["clock"].update(rate=0), r"Camera 'cam02' .*rate 0"),
        (lambda values: values["cameras"]["cam02"]["clock"].update(offset_seconds=math.nan), r"Camera 'cam02' .*nan"),
        (
            lambda values: values["cameras"]["cam02"].update(lens={"model": "opencv", "k1": math.nan}),
            r"Camera 'cam02' .*not finite \(nan\)",
        ),
        (
            lambda values: values["cameras"]["cam02"]["pinhole"].update(size=[0, 9]),
            r"Camera 'cam02' of .*capture\.json .*a picture of 0x9 pixels",
        ),
    ],
)
def test_broken_content_is_named(tmp_path: Path, change: Callable[[dict[str, Any]], object], reported: str) -> None:
    write_prepared(tmp_path, content())
    edit_json(tmp_path / FILE, change)
    with pytest.raises(CalibrationError, match=reported):
        read_prepared(tmp_path)


def test_a_missing_video_is_named(tmp_path: Path) -> None:
    write_prepared(tmp_path, content())
    with pytest.raises(CaptureError, match=r"cam00\.mp4 of camera 'cam00' is missing; restore it"):
        open_prepared(tmp_path)


def test_points_may_not_be_a_pickle(tmp_path: Path) -> None:
    capture = replace(content(), points="points.npy")
    write_videos(tmp_path / "videos", list(capture.cameras), frames=2)
    np.save(tmp_path / "points.npy", np.array([{"a": 1}], object), allow_pickle=True)
    write_prepared(tmp_path, capture)
    with pytest.raises(CalibrationError, match=r"points\.npy cannot be read"):
        open_prepared(tmp_path)
