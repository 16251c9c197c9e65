# SPDX-License-Identifier: Apache-2.0
"""Every way from videos to a capture: steps, resuming, what the capture says of a known truth, and what is refused."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.data.open import open_capture
from structgstream.data.prepared import PreparedCapture, read_prepared
from structgstream.data.timeline import Clock
from structgstream.errors import CalibrationError
from structgstream.preparation.footage import find_footage
from structgstream.preparation.options import Distance, PrepareOptions
from structgstream.preparation.prepare import Job, Preparation, prepare_capture
from structgstream.preparation.solvers import first_clocks, matched_pictures
from tests.support.calibration_errors import calibration_errors
from tests.support.captures import write_picture, write_video, write_videos
from tests.support.filmed import Film, noise_texture, ring, room
from tests.support.footage_made import BOARD, FPS, centred, put_sound, write_board_take, write_take
from tests.support.planes import room_frame
from tests.support.rooms import write_room
from tests.support.takes import heard

NONE = PrepareOptions(synchronize="none")


def test_a_capture_is_made_once_and_only_what_changed_again(tmp_path: Path) -> None:
    rig = write_room(tmp_path / "videos")
    made = prepare_capture(tmp_path / "videos", tmp_path / "out", options=NONE)
    assert made.skipped == ()
    assert not [finding for finding in made.findings if finding.severity == "error"]
    assert made.report.is_file()
    source = open_capture(tmp_path / "out")
    assert (len(source), source.fps) == (2, 30.0)
    assert source.points is not None
    for name in rig:
        assert torch.equal(source.rig[name].viewmat, rig[name].viewmat)
        assert 0.6 < source.rig[name].near < 1.4  # the board stands 2.5 in front of the cameras
    assert made.steps["sound"] == "no camera has any"
    assert read_prepared(tmp_path / "out").sound is None
    again = prepare_capture(tmp_path / "videos", tmp_path / "out", options=NONE)
    assert set(again.skipped) == {"synchronize", "calibrate", "scale", "near", "points", "check", "sound"}
    assert again.findings == made.findings
    distance = Distance("cam00", "cam04", 2.0)
    metres = prepare_capture(tmp_path / "videos", tmp_path / "out", options=replace(NONE, distance=distance))
    assert set(metres.skipped) == {"synchronize", "calibrate", "sound"}
    found = read_prepared(tmp_path / "out")
    assert found.unit == "metres"
    one, other = (found.cameras[name].pinhole.center for name in ("cam00", "cam04"))
    assert float((one - other).norm()) == pytest.approx(2.0)


def write_pictures(folder: Path, frames: int) -> None:
    """The room as folders of pictures, a corner of which holds the frame's number."""
    rig = write_room(folder, cameras=4)
    for name, image in room_frame(rig).images.items():
        (folder / f"{name}.mp4").unlink()
        for frame in range(frames):
            numbered = image.copy()
            numbered[:10, :10] = 40 * frame
            write_picture(folder / name / f"{frame:04d}.png", numbered)


def carried(capture: Path) -> list[dict[str, int]]:
    return [
        {name: int(image[3, 3, 0]) // 40 for name, image in frame.images.items()}
        for frame in open_capture(capture).frames()
    ]


def test_a_picture_that_lacks_is_no_other_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the first time, or deleted between two runs: its camera is absent there, and in step after it."""
    monkeypatch.setattr(Job, "points", lambda self, content: content)
    monkeypatch.setattr(Job, "check", lambda self, content: ())
    options = replace(NONE, near=0.3)
    write_pictures(tmp_path / "videos", 5)
    names = ("cam00", "cam01", "cam02", "cam03")
    prepare_capture(tmp_path / "videos", tmp_path / "out", options=options)
    assert carried(tmp_path / "out") == [dict.fromkeys(names, frame) for frame in range(5)]
    (tmp_path / "videos" / "cam02" / "0003.png").unlink()
    for out in ("out", "new"):
        prepare_capture(tmp_path / "videos", tmp_path / out, options=options)
        wanted = [dict.fromkeys(names, frame) for frame in range(5)]
        del wanted[3]["cam02"]
        assert carried(tmp_path / out) == wanted
    assert (tmp_path / "videos" / "cam02" / "0004.png").is_file()


def test_an_interrupted_preparation_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    write_room(tmp_path / "videos", cameras=4)
    monkeypatch.setattr(Job, "check", lambda self, content: ())
    with monkeypatch.context() as patched:
        patched.setattr("structgstream.preparation.prepare.frame_points", interrupt)
        with pytest.raises(KeyboardInterrupt):
            prepare_capture(tmp_path / "videos", tmp_path / "out", options=NONE)
    assert len(open_capture(tmp_path / "out")) == 2
    made = prepare_capture(tmp_path / "videos", tmp_path / "out", options=NONE)
    assert "near" in made.skipped
    assert "points" not in made.skipped


@pytest.fixture
def without_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test is about what comes before initial points."""
    monkeypatch.setattr(Job, "points", lambda self, content: content)


@pytest.fixture
def without_check(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test is about what comes before the check."""
    monkeypatch.setattr(Job, "check", lambda self, content: ())


def errors(made: Preparation) -> list[str]:
    return [finding.sentence for finding in made.findings if finding.severity == "error"]


def starts_in_frames(capture: PreparedCapture, fps: float) -> np.ndarray:
    """When each camera began, relative to their mean."""
    starts = np.array([camera.clock.offset_seconds * fps for camera in capture.cameras.values()])
    return starts - starts.mean()


def test_motion_and_structure_without_any_calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where motion alone tells no clocks: the calibration comes from what stands still."""
    monkeypatch.setattr("structgstream.preparation.solvers.SURE_PERIODS", 0.0)
    starts = [0, 7, 3, 12]
    truth = write_take(tmp_path / "videos", starts=starts, frames=36)
    made = prepare_capture(tmp_path / "videos", tmp_path / "out", options=PrepareOptions(lens="pinhole", instants=1))
    assert not errors(made)
    assert "clocks" in made.steps
    found = read_prepared(tmp_path / "out")
    assert np.abs(starts_in_frames(found, FPS) - (np.array(starts) - np.mean(starts))).max() < 0.3
    filmed = {name: camera.filmed for name, camera in found.cameras.items()}
    for error in calibration_errors(filmed, truth).values():
        assert error.rotation_degrees < 0.3
        assert error.position_percent < 1.5
    page = made.report.read_text()
    assert "sound cannot be used" in page  # why clocks come from motion


def test_pictures_of_what_stands_still_need_no_clocks(tmp_path: Path) -> None:
    still = {}
    for name, seed in (("a", 1), ("b", 2), ("c", 3)):
        still[name] = noise_texture(seed, size=64)
        moving = [still[name].copy() for _ in range(9)]
        if name == "a":
            for index, one in enumerate(moving):
                one[:, 7 * index : 7 * index + 7] = 255
        write_video(tmp_path / f"{name}.mp4", moving)
    footage = find_footage(tmp_path)
    clocks = first_clocks(footage, PrepareOptions(synchronize="motion"))
    assert not clocks.sure
    assert "Too little moves in the pictures of 'b', 'c'" in clocks.summary
    for name, pictures in matched_pictures(footage, clocks, PrepareOptions()).items():
        assert len(pictures) == 1
        assert np.abs(pictures[0].astype(int) - still[name]).max() <= 4


@pytest.mark.usefixtures("without_points", "without_check")
def test_sound(tmp_path: Path) -> None:
    rig = write_room(tmp_path / "videos", cameras=4, frames=150)
    clocks = {name: Clock(0.31 * index) for index, name in enumerate(rig)}
    for name, samples in heard(clocks, seconds=5).items():
        put_sound(tmp_path / "videos" / f"{name}.mp4", samples)
    made = prepare_capture(tmp_path / "videos", tmp_path / "out")
    found = read_prepared(tmp_path / "out")
    assert made.steps["synchronize"].startswith("audio: all cameras have sound")
    truth = np.array([clock.offset_seconds for clock in clocks.values()])
    assert np.abs(starts_in_frames(found, 1.0) - (truth - truth.mean())).max() < 1e-3


@pytest.mark.usefixtures("without_points", "without_check")
def test_a_board(tmp_path: Path) -> None:
    rig = centred(ring(3, radius=1.1, arc_degrees=50, focal=300, size=(360, 270)))
    write_board_take(tmp_path / "board", rig, instants=16, period=0.4)
    for index, (name, filmed) in enumerate(rig.items()):
        write_video(tmp_path / "videos" / f"{name}.mp4", [Film(filmed).picture(room(), noise=1, seed=index)] * 2)
    options = replace(NONE, calibration="board", board=BOARD, board_videos=tmp_path / "board", lens="pinhole")
    prepare_capture(tmp_path / "videos", tmp_path / "out", options=options)
    found = read_prepared(tmp_path / "out")
    assert found.unit == "metres"
    for error in calibration_errors({name: camera.filmed for name, camera in found.cameras.items()}, rig).values():
        assert error.rotation_degrees < 0.2
        assert error.position_percent < 1


@pytest.mark.usefixtures("without_points", "without_check")
def test_refined_and_in_metres(tmp_path: Path) -> None:
    rig = write_room(tmp_path / "videos")
    options = replace(NONE, refine=True, distance=Distance("cam00", "cam04", 2.0))
    made = prepare_capture(tmp_path / "videos", tmp_path / "out", options=options)
    assert "px from their epipolar lines" in made.steps["refine"]
    found = read_prepared(tmp_path / "out")
    assert found.unit == "metres"
    centers = {name: camera.pinhole.center for name, camera in found.cameras.items()}
    assert float((centers["cam00"] - centers["cam04"]).norm()) == pytest.approx(2.0)
    scale = 2.0 / float((rig["cam00"].center - rig["cam04"].center).norm())
    across = float((centers["cam01"] - centers["cam03"]).norm())
    assert across == pytest.approx(scale * float((rig["cam01"].center - rig["cam03"].center).norm()), rel=0.02)


def test_dead_cameras_are_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_room(tmp_path / "videos", cameras=4, frames=9)
    short = tmp_path / "short"
    write_room(short, cameras=4, frames=4)
    (short / "cam02.mp4").replace(tmp_path / "videos" / "cam02.mp4")
    with caplog.at_level(logging.WARNING):
        made = prepare_capture(tmp_path / "videos", tmp_path / "out", options=NONE)
    assert sum("'cam02' ends with" in record.getMessage() for record in caplog.records) == 1
    (found,) = [finding for finding in made.findings if "ends with frame 3" in finding.sentence]
    assert (found.severity, found.cameras) == ("warning", ("cam02",))
    assert "is absent from the 5 frames after that" in made.report.read_text()


def test_a_board_that_is_not_there(tmp_path: Path) -> None:
    write_videos(tmp_path / "videos", ["a", "b", "c"], frames=2)
    with pytest.raises(CalibrationError, match=r"No camera shows the board .* in any of its"):
        prepare_capture(tmp_path / "videos", tmp_path / "out", options=replace(NONE, calibration="board"))
