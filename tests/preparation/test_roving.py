# SPDX-License-Identifier: Apache-2.0
"""A roving video in ``prepare``: which of its frames are used, and what the capture has of them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from structgstream.api import reconstruct
from structgstream.codec.reader import open_stream
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import open_capture
from structgstream.data.prepared import read_prepared
from structgstream.data.roving import roving_of
from structgstream.errors import CaptureError
from structgstream.evaluation.recording import capture_of
from structgstream.preparation import prepare as preparation
from structgstream.preparation import solvers
from structgstream.preparation.calibration.solved import Observations, RovingFrames, SolvedCalibration
from structgstream.preparation.footage import open_roving, sharpest_frames, write_png
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.prepare import prepare_capture
from tests.support.captures import write_picture, write_video
from tests.support.filmed import noise_texture
from tests.support.planes import HEIGHT, WIDTH, room_frame, room_rig
from tests.support.rooms import write_room
from tests.support.small_presets import QUICK

OPTIONS = PrepareOptions(synchronize="none", calibration="sfm")
LENGTH = 40


def walk(folder: Path, *, frames: int = LENGTH, blurred: Sequence[int] = (), fps: float = 8.0) -> Path:
    """A video of a wall, of which some frames are blurred."""
    wall = noise_texture(3, size=160)[:120]
    pictures = []
    for number in range(frames):
        picture = np.roll(wall, 2 * number, axis=1)
        pictures.append(np.asarray(cv2.GaussianBlur(picture, (0, 0), 3)) if number in blurred else picture)
    file = folder / "walk.mp4"
    write_video(file, pictures, instants=[30.0 / fps * number for number in range(frames)])
    return file


def test_the_sharpest_frames_of_equal_parts_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("structgstream.preparation.footage.ROVING_FRAMES", 8)
    file = walk(tmp_path, blurred=[number for number in range(LENGTH) if number % 5 != 3])
    found = sharpest_frames(open_roving(file))
    assert list(found) == [f"roving/{number:06d}" for number in range(3, LENGTH, 5)]


def test_a_folder_of_pictures_is_one_camera(tmp_path: Path) -> None:
    for number in range(9):
        write_picture(tmp_path / "walk" / f"IMG_{number:04d}.png", noise_texture(number, size=64)[:48])
    assert len(sharpest_frames(open_roving(tmp_path / "walk"))) == 9


def test_what_is_no_roving_video_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="The roving video .*none.mp4 does not exist"):
        open_roving(tmp_path / "none.mp4")
    (tmp_path / "walk.txt").touch()
    with pytest.raises(CaptureError, match=r"walk.txt is no video"):
        open_roving(tmp_path / "walk.txt")
    with pytest.raises(
        CaptureError, match=r"is too short \(16 frames of 1.9 s\); walk through the set for half a minute"
    ):
        open_roving(walk(tmp_path, frames=16))
    write_picture(tmp_path / "few" / "0.png", noise_texture(0, size=64))
    with pytest.raises(CaptureError, match=r"is too short \(1 frames\)"):
        open_roving(tmp_path / "few")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureError, match=r"The folder .*empty holds no pictures; give a video"):
        open_roving(tmp_path / "empty")


def solved(pictures: Any, *, roving: Any, **options: Any) -> SolvedCalibration:
    """The room's cameras, and of the frames every one but the first, at the place of a camera."""
    rig = room_rig(5)
    none = np.empty(0, np.intp)
    found = None
    if roving is not None:
        filmed = LensCamera(rig["cam02"], Pinhole())
        found = RovingFrames(dict.fromkeys(list(roving)[1:], filmed), len(roving), 0.42, ("cam03",))
    return SolvedCalibration(
        {name: LensCamera(camera, Pinhole()) for name, camera in rig.cameras.items()},
        np.empty((0, 3)),
        Observations(none, none, np.empty((0, 2)), none),
        roving=found,
    )


def write_walk(folder: Path, *, darker: int = 1) -> Path:
    """Nine pictures of the room from the place of a camera."""
    picture = room_frame(room_rig(5)).images["cam02"] // darker
    assert picture.shape == (HEIGHT, WIDTH, 3)
    for number in range(9):
        write_picture(folder / f"{number:04d}.png", picture)
    return folder


def test_registered_frames_are_in_the_capture_and_train_frame_0_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solvers, "solve_structure", solved)
    write_room(tmp_path / "videos")
    out = tmp_path / "out"
    options = replace(OPTIONS, roving=write_walk(tmp_path / "walk"))
    made = prepare_capture(tmp_path / "videos", out, options=options)
    said = "8 of 9 roving frames, median reprojection error 0.42 px, which connect cam03"
    assert made.steps["calibrate"].endswith(said)
    content = read_prepared(out)
    names = [f"roving/{number:06d}" for number in range(1, 9)]
    assert list(content.roving) == names
    assert sorted(file.name for file in (out / "roving").iterdir()) == [f"{number:06d}.png" for number in range(1, 9)]
    assert list(open_capture(out).rig) == list(room_rig(5))
    again = prepare_capture(tmp_path / "videos", out, options=options)
    assert "calibrate" in again.skipped
    assert again.steps["calibrate"] == made.steps["calibrate"]

    for use in (True, False):
        reports = reconstruct(out, tmp_path / f"{use}.sgs", preset=QUICK, roving=use, held_out=(), backend="cpu")
        assert len(reports) == 2
    with open_stream(tmp_path / "True.sgs") as one, open_stream(tmp_path / "False.sgs") as other:
        assert one.header.metadata["roving"] == 8
        assert "roving" not in other.header.metadata
        assert list(one.header.rig) == list(other.header.rig) == list(room_rig(5))
        # What only looks at a stream needs none of them.
        (out / "roving" / "000004.png").unlink()
        with pytest.raises(CaptureError, match="is missing"):
            open_capture(out)
        for header in (one.header, other.header):
            assert roving_of(capture_of(header, out, frames=None)) is None

    without = prepare_capture(tmp_path / "videos", out, options=OPTIONS)
    assert "calibrate" not in without.skipped
    assert not read_prepared(out).roving
    assert not list((out / "roving").iterdir())
    assert roving_of(open_capture(out)) is None


def test_pictures_are_of_the_video_that_is_given_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solvers, "solve_structure", solved)
    write_room(tmp_path / "videos")
    out, picture = tmp_path / "out", tmp_path / "out" / "roving" / "000004.png"
    one, other = write_walk(tmp_path / "one"), write_walk(tmp_path / "other", darker=2)
    prepare_capture(tmp_path / "videos", out, options=replace(OPTIONS, roving=one))
    before = cv2.imread(str(picture))

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(preparation, "assembled", interrupted)  # after the calibration
        with pytest.raises(KeyboardInterrupt):
            prepare_capture(tmp_path / "videos", out, options=replace(OPTIONS, roving=other))
    made = prepare_capture(tmp_path / "videos", out, options=replace(OPTIONS, roving=other))
    assert "calibrate" in made.skipped
    np.testing.assert_array_equal(cv2.imread(str(picture)), before // 2)

    with monkeypatch.context() as patched:
        written = []

        def first_alone(path: Path, shown: Any) -> None:
            if len(written) == 4:
                raise KeyboardInterrupt
            written.append(path)
            write_png(path, shown)

        patched.setattr(preparation, "write_png", first_alone)
        with pytest.raises(KeyboardInterrupt):
            prepare_capture(tmp_path / "videos", out, options=replace(OPTIONS, roving=one))
    made = prepare_capture(tmp_path / "videos", out, options=replace(OPTIONS, roving=other))
    assert "roving" not in made.skipped
    np.testing.assert_array_equal(cv2.imread(str(picture)), before // 2)
    again = prepare_capture(tmp_path / "videos", out, options=replace(OPTIONS, roving=other))
    assert "roving" in again.skipped


def test_a_roving_video_among_the_others_is_no_still_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solvers, "solve_structure", solved)
    write_room(tmp_path / "videos")
    file = walk(tmp_path / "videos")
    made = prepare_capture(tmp_path / "videos", tmp_path / "out", options=replace(OPTIONS, roving=file))
    assert made.steps["link"].startswith("5 cameras")
    assert list(read_prepared(tmp_path / "out").cameras) == list(room_rig(5))
