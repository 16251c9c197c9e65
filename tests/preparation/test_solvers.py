# SPDX-License-Identifier: Apache-2.0
"""Clocks and cameras by each method: which way, what is refused, and what is kept of it."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from structgstream.data.calibration import Calibration, PosedCamera, rigid
from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole, RadialTangential
from structgstream.data.timeline import Clock
from structgstream.errors import CalibrationError, CaptureError, ConfigError
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.output_folder import Stored
from structgstream.preparation.prepare import check_used, chosen_method
from structgstream.preparation.solvers import (
    TIMESTAMPS,
    board_footage,
    check_complete,
    describe_focals,
    describe_turns,
    first_clocks,
    given_cameras,
    packed,
    stated_focals,
    summary,
    synchronized,
    unpacked,
)
from tests.support.captures import write_video
from tests.support.filmed import ring
from tests.support.rooms import write_room

NAMES = ("a", "b", "c")


def picture(value: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    return np.full((size[1], size[0], 3), value, np.uint8)


def filmed(
    folder: Path, *, frames: int = 12, size: tuple[int, int] = (64, 48), names: tuple[str, ...] = NAMES
) -> Footage:
    """Videos at 30 frames a second whose brightness rises by 10 a frame, by 1 a camera."""
    for index, name in enumerate(names):
        write_video(folder / f"{name}.mp4", [picture(20 + 10 * i + index, size) for i in range(frames)])
    return find_footage(folder)


def table(footage: Footage, late: dict[str, float]) -> None:
    """``timestamps.csv`` of cameras that are late."""
    lines = ["camera,frame,seconds"]
    for name in footage.cameras:
        lines += [f"{name},{i},{i / 30 + late.get(name, 0.0):.6f}" for i in range(len(footage.stamps(name)))]
    (footage.where / TIMESTAMPS).write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("videos", "beside"), [("", ""), ("videos", ""), ("videos", "videos")])
def test_a_table_of_times_is_taken_by_itself(tmp_path: Path, videos: str, beside: str) -> None:
    filmed(tmp_path / videos)
    footage = find_footage(tmp_path)
    table(footage, {"b": 0.1})
    (tmp_path / TIMESTAMPS).replace(tmp_path / beside / TIMESTAMPS)
    found = synchronized(footage, PrepareOptions())
    assert (found.method, found.sure) == ("csv", True)
    starts = {name: clock.offset_seconds for name, clock in found.clocks.items()}
    assert starts["b"] - starts["a"] == pytest.approx(0.1, abs=1e-4)
    assert starts["c"] - starts["a"] == pytest.approx(0.0, abs=1e-4)


def test_single_pictures_have_no_clocks(tmp_path: Path) -> None:
    footage = filmed(tmp_path, frames=1)
    assert synchronized(footage, PrepareOptions(synchronize="audio")).method == "none"


def test_who_asked_for_nothing_is_reported_none(tmp_path: Path) -> None:
    footage = filmed(tmp_path)
    with pytest.raises(CaptureError, match="--synchronize none") as asked:
        synchronized(footage, PrepareOptions())
    with pytest.raises(CaptureError) as named:
        synchronized(footage, PrepareOptions(synchronize="audio"))
    assert "Cameras that one signal starts" in str(asked.value)
    assert "Cameras that one signal starts" not in str(named.value)


def test_before_a_calibration_motion_may_fail_and_nothing_else(tmp_path: Path) -> None:
    footage = filmed(tmp_path)
    for how in ("auto", "motion"):
        found = first_clocks(footage, PrepareOptions(synchronize=how))
        assert (found.method, found.sure, dict(found.clocks)) == ("motion", False, dict.fromkeys(NAMES, Clock()))
        assert found.summary.startswith("motion: not without the calibration. ")
    with pytest.raises(CaptureError):
        first_clocks(footage, PrepareOptions(synchronize="audio"))
    (tmp_path / TIMESTAMPS).write_text("a,b\n")
    with pytest.raises(CaptureError, match="timestamps.csv"):
        first_clocks(footage, PrepareOptions())


def test_videos_without_a_moment_in_common(tmp_path: Path) -> None:
    footage = filmed(tmp_path)
    table(footage, {"b": 9.0})
    with pytest.raises(CaptureError, match="no instant in common"):
        synchronized(footage, PrepareOptions())


def test_the_board_is_filmed_by_all_in_the_same_mode(tmp_path: Path) -> None:
    footage = filmed(tmp_path / "take")
    filmed(tmp_path / "board", frames=3, names=(*NAMES, "d"))
    options = PrepareOptions(board_videos=tmp_path / "board")
    assert board_footage(footage, options).cameras == NAMES
    (tmp_path / "board" / "b.mp4").unlink()
    with pytest.raises(CaptureError, match="board has no video of camera 'b' of .*take; film the board with it too"):
        board_footage(footage, options)
    filmed(tmp_path / "board", frames=3, names=("b",), size=(48, 64))
    with pytest.raises(CalibrationError, match="'b' filmed the board with 48x64 pixels .* and the take with 64x48"):
        board_footage(footage, options)
    assert board_footage(footage.only(("a", "c")), replace(options, fps=25)).cameras == ("a", "c")


def write(path: Path, film: int | None, *, orientation: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    if film is not None:
        exif.get_ifd(0x8769)[0xA405] = film
    Image.new("RGB", (400, 300)).save(path, exif=exif)


def test_the_first_picture_of_each_camera_counts(tmp_path: Path) -> None:
    for name, film in {"a": 26, "b": None, "c": 52}.items():
        write(tmp_path / name / "0.jpg", film)
        write(tmp_path / name / "1.jpg", 90)
    footage = find_footage(tmp_path)
    focals = stated_focals(footage)
    one = 26 * 500 / math.hypot(36, 24)
    assert focals == {"a": pytest.approx(one), "c": pytest.approx(2 * one)}
    assert describe_focals(focals, footage) == (
        "began with the focal lengths that the pictures of 2 of 3 cameras state (0.751 to 1.502 of the longer side)"
    )
    assert "state (0.751 of the longer side)" in describe_focals({"a": one}, footage)


def test_videos_state_none(tmp_path: Path) -> None:
    for name in "ab":
        write_video(tmp_path / f"{name}.mp4", [np.zeros((48, 64, 3), np.uint8)])
    footage = find_footage(tmp_path)
    assert stated_focals(footage) == {}
    assert describe_focals({}, footage) == ""


def test_pictures_that_say_that_they_are_to_be_turned(tmp_path: Path) -> None:
    for name, orientation in {"a": 1, "b": 6, "c": 8}.items():
        write(tmp_path / f"{name}.jpg", None, orientation=orientation)
    footage = find_footage(tmp_path)
    assert describe_turns(footage).startswith("the files of ")
    assert "'b'" in describe_turns(footage)
    assert "'a'" not in describe_turns(footage)
    assert footage.size("b") == (400, 300), "as stored"
    assert describe_turns(footage.only(["a"])) == ""


NONE = np.empty(0, np.intp)


def footage(where: Path, *names: str) -> Footage:
    return Footage(where, {name: where / f"{name}.mp4" for name in names}, {}, {})


def solved(rig: dict[str, LensCamera], *, off: tuple[float, float] | None = (3.0, 4.0)) -> SolvedCalibration:
    """A rig with one point in its middle, which is seen so many pixels away from where it is; None: no points."""
    if off is None:
        return SolvedCalibration(rig, np.empty((0, 3)), Observations(NONE, NONE, np.empty((0, 2)), NONE))
    cameras = np.arange(len(rig), dtype=np.intp)
    pixels = np.concatenate([filmed.pixels(np.zeros((1, 3))) + off for filmed in rig.values()])
    return SolvedCalibration(rig, np.zeros((1, 3)), Observations(0 * cameras, cameras, pixels, 0 * cameras))


def test_what_is_asked_for_is_taken(tmp_path: Path) -> None:
    there = footage(tmp_path, "a", "b", "c")
    for method in ("sfm", "board"):
        assert chosen_method(there, PrepareOptions(calibration=method)) == method
    assert chosen_method(there, PrepareOptions(board_videos=tmp_path)) == "board"
    assert chosen_method(there, PrepareOptions()) == "sfm"


def test_a_calibration_beside_the_videos_is_found_and_another_can_be_named(tmp_path: Path) -> None:
    write_room(tmp_path / "videos", cameras=3)
    there = footage(tmp_path / "videos", "cam00", "cam01", "cam02")
    found = chosen_method(there, PrepareOptions())
    assert isinstance(found, Calibration)
    assert found.where.name == "cameras.json"
    assert chosen_method(there, PrepareOptions(board_videos=tmp_path)) == "board"
    assert chosen_method(there, PrepareOptions(calibration="sfm")) == "sfm"
    other = chosen_method(footage(tmp_path, "a"), PrepareOptions(calibration=tmp_path / "videos"))
    assert isinstance(other, Calibration)
    with pytest.raises(CalibrationError, match="nowhere"):
        chosen_method(there, PrepareOptions(calibration=tmp_path / "nowhere"))


def test_what_would_have_no_effect_is_refused(tmp_path: Path) -> None:
    write_room(tmp_path, cameras=3)
    there = find_footage(tmp_path)
    given = chosen_method(there, PrepareOptions())
    stills = Footage(tmp_path, {}, {}, {})
    for method, options, reported in (
        ("sfm", PrepareOptions(fps=25), "leave out --fps"),
        ("sfm", PrepareOptions(board_videos=tmp_path), "--calibration board alone"),
        ("board", PrepareOptions(intrinsics="shared"), "by structure from motion alone"),
        (given, PrepareOptions(lens="fisheye"), r"cameras\.json states the lenses, so --lens fisheye has no effect"),
        ("sfm", PrepareOptions(board=Board(10, 7, 0.03)), r"A board \(--board\) is looked for by --calibration board"),
        ("sfm", PrepareOptions(roving=tmp_path, refine=True), "adjusts the still cameras alone"),
        (given, PrepareOptions(roving=tmp_path), "registered by structure from motion alone"),
        ("sfm", PrepareOptions(lens="brown", refine=True), "model brown cannot be refined; take --lens opencv"),
        ("board", PrepareOptions(board_videos=tmp_path / "nowhere"), "nowhere is missing; give the folder"),
    ):
        with pytest.raises((ConfigError, CaptureError), match=reported):
            check_used(method, there, options)
    check_used("sfm", stills, PrepareOptions(fps=25))
    check_used("board", there, PrepareOptions(board_videos=tmp_path, lens="brown"))
    check_used("sfm", there, PrepareOptions(intrinsics="shared", lens="brown"))
    check_used(given, there, PrepareOptions(lens="fisheye", refine=True))


def test_pixels_that_are_not_square_need_a_calibration_of_another_tool(tmp_path: Path) -> None:
    """As of HDV and of anamorphic modes; the ratio of the focal lengths would hardly follow."""
    write_room(tmp_path, cameras=3)
    there = find_footage(tmp_path)
    given = chosen_method(there, PrepareOptions())
    for aspect, refused in ((4 / 3, True), (2025 / 2024, False)):
        one = there.tracks["cam01"]
        filmed = replace(there, tracks={**there.tracks, "cam01": replace(one, pixel_aspect=aspect)})
        check_used(given, filmed, PrepareOptions())
        if refused:
            with pytest.raises(CaptureError, match=r"cam01\.mp4 are 1\.33 times as wide as high .*square pixels"):
                check_used("sfm", filmed, PrepareOptions())
        else:
            check_used("sfm", filmed, PrepareOptions())


def test_every_camera_is_placed_or_named(tmp_path: Path) -> None:
    found = solved(ring(3, radius=2.6, arc_degrees=40))
    assert check_complete(found, footage(tmp_path, "cam00", "cam02")) is found
    with pytest.raises(CalibrationError, match="'x', 'y z'.* among the other 3: .* --without x 'y z'"):
        check_complete(found, footage(tmp_path, "cam00", "x", "cam01", "y z"))


def test_the_calibration_of_another_tool_is_for_these_pictures(tmp_path: Path) -> None:
    rig = write_room(tmp_path, cameras=3)
    (tmp_path / "cameras.json").rename(tmp_path / "moved.json")
    (tmp_path / "calibration").mkdir()
    (tmp_path / "moved.json").rename(tmp_path / "calibration" / "cameras.json")
    there = find_footage(tmp_path)
    calibration = chosen_method(there, PrepareOptions(calibration=tmp_path / "calibration"))
    assert isinstance(calibration, Calibration)
    found = given_cameras(calibration, there)
    assert list(found.cameras) == ["cam00", "cam01", "cam02"]
    for name, filmed in found.cameras.items():
        np.testing.assert_allclose(filmed.camera.viewmat.numpy(), rig[name].viewmat.numpy(), atol=1e-6)
    assert (len(found.points), len(found.observations)) == (0, 0)
    write_video(tmp_path / "cam03.mp4", [np.zeros((120, 160, 3), np.uint8)])
    with pytest.raises(CalibrationError, match="cam03"):
        given_cameras(calibration, find_footage(tmp_path))


@pytest.mark.parametrize(("by_exif", "reason"), [(True, "turn them without loss"), (None, "export the pictures")])
def test_a_calibration_of_turned_pictures_is_refused_for_stored_ones(
    tmp_path: Path, by_exif: bool | None, reason: str
) -> None:
    """As OpenCV's tools calibrate them; `reconstruct` turns such pictures, a prepared capture does not."""
    exif = Image.Exif()
    exif[0x112] = 3
    cameras = tuple(
        PosedCamera(
            name, rigid(np.eye(3), [x, 0, 0]), np.array([[8.0, 0, 4], [0, 8.0, 3], [0, 0, 1]]), (8, 6), Pinhole()
        )
        for x, name in enumerate("abc")
    )
    for camera in cameras:
        Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(tmp_path / f"{camera.name}.jpg", exif=exif)
    calibration = Calibration(tmp_path / "intri.yml", cameras, turned_by_exif=by_exif)
    with pytest.raises(CalibrationError, match=reason):
        given_cameras(calibration, find_footage(tmp_path))
    assert len(given_cameras(replace(calibration, turned_by_exif=False), find_footage(tmp_path)).cameras) == 3


@pytest.mark.parametrize(
    "lens", [Pinhole(), RadialTangential(k1=-0.1, p2=0.001, k6=0.01), Fisheye(0.02, -0.005, 0.001)]
)
def test_what_is_kept_comes_back(lens: Lens) -> None:
    """Through JSON, as steps keep it."""
    rig = ring(3, radius=2.6, arc_degrees=40, lens=lens)
    given = replace(solved(rig), missing=("x",), metres=True)
    stored = packed(given)
    found = unpacked(Stored(json.loads(json.dumps(stored.values)), stored.arrays))
    assert (found.missing, found.metres, list(found.cameras)) == (("x",), True, list(rig))
    for name, filmed in found.cameras.items():
        assert filmed.lens == lens
        assert (filmed.camera.viewmat == rig[name].camera.viewmat).all()
        assert (filmed.camera.K == rig[name].camera.K).all()
        assert (filmed.camera.width, filmed.camera.height) == (rig[name].camera.width, rig[name].camera.height)
    np.testing.assert_array_equal(found.errors(), given.errors())


def test_a_calibration_in_a_line() -> None:
    rig = ring(3, radius=2.6, arc_degrees=40)
    assert summary(solved(rig)) == "3 cameras, 1 points, median reprojection error 5.00 px"
    assert summary(solved(rig, off=None)) == "3 cameras"
