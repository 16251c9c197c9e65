# SPDX-License-Identifier: Apache-2.0
"""The steps up to a calibration and from it to a capture: what each depends on, and what is done again."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from structgstream.data.calibration import Calibration
from structgstream.data.prepared import PreparedCapture, prepared_entries, read_prepared
from structgstream.data.timeline import Clock
from structgstream.errors import CalibrationError, ConfigError
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.options import Distance, PrepareOptions
from structgstream.preparation.output_folder import FOLDER, SOURCE, Silent, Steps
from structgstream.preparation.prepare import POINTS, Job, assembled, chosen_method
from structgstream.preparation.solvers import TIMESTAMPS, Clocks, given_cameras
from tests.support.calibrations import opencv_matrix
from tests.support.footage_made import still_room
from tests.support.rooms import write_room

NONE = PrepareOptions(synchronize="none")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("room")
    write_room(where, cameras=4)
    return where


def job(room: Path, capture: Path, options: PrepareOptions = NONE) -> Job:
    return Job(room, capture, options, Steps(capture, Silent()))


def run(job: Job) -> tuple[Clocks, SolvedCalibration]:
    """All steps with the calibration that lies beside the videos."""
    footage = job.find()
    method = chosen_method(footage, job.options)
    clocks = job.synchronize(footage, method)
    solved = job.calibrate(footage, clocks, method)
    assert job.synchronize_again(footage, clocks, method, solved) is clocks
    return clocks, solved


def test_what_was_found_is_described_and_claimed(room: Path, tmp_path: Path) -> None:
    one = job(room, tmp_path / "out")
    footage = one.find()
    assert footage.cameras == ("cam00", "cam01", "cam02", "cam03")
    assert one.steps.summaries["find"] == "4 videos, 160x120, 2 frames, 30 a second"
    assert (tmp_path / "out" / FOLDER / SOURCE).is_file()
    assert job(room, tmp_path / "o", replace(NONE, without=("cam01",))).find().cameras == (
        "cam00", "cam02", "cam03",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        ({"without": ("nobody",)}, "has no camera .* to leave out; its cameras are cam0"),
        ({"held_out": ("nobody",)}, "has no camera .* to hold out; its cameras are cam0"),
        ({"held_out": ("cam00",), "without": ("cam00",)}, "has no camera .* to hold out; its cameras are cam0"),
        ({"distance": Distance("cam00", "nobody", 1.0)}, "has no camera .* to measure from; its cameras are cam0"),
        ({"held_out": ("cam00", "cam01", "cam02")}, "4 cameras, 3 of them held out; a reconstruction needs 2 or more"),
        ({"without": ("cam00", "cam01")}, "needs 3 or more"),
    ],
)
def test_what_cannot_be_costs_no_time(room: Path, tmp_path: Path, options: dict[str, Any], reported: str) -> None:
    kind = CalibrationError if "3 or more" in reported else ConfigError
    with pytest.raises(kind, match=reported):
        job(room, tmp_path / "out", replace(NONE, **options)).find()
    assert not (tmp_path / "out").exists()


def test_two_cameras_to_train_on_are_enough(room: Path, tmp_path: Path) -> None:
    job(room, tmp_path / "out", replace(NONE, held_out=("cam00", "cam01"))).find()


@pytest.mark.parametrize(
    ("options", "done"),
    [
        (replace(NONE, distance=Distance("cam00", "cam02", 3.0)), ["scale"]),
        (replace(NONE, near=0.2, held_out=("cam01",)), []),
        (replace(NONE, instants=5), ["calibrate", "scale"]),
        (replace(NONE, without=("cam03",)), ["synchronize", "calibrate", "scale"]),
    ],
)
def test_a_change_does_what_depends_on_it(room: Path, tmp_path: Path, options: PrepareOptions, done: list[str]) -> None:
    before, _ = run(job(room, tmp_path / "out"))
    changed = job(room, tmp_path / "out", options)
    clocks, solved = run(changed)
    assert clocks == before or "synchronize" in done
    assert [step for step in ("synchronize", "calibrate", "scale") if step not in changed.steps.skipped] == done
    assert solved.metres == (options.distance is not None)


def test_a_table_of_times_that_comes_later_is_looked_at(tmp_path: Path) -> None:
    write_room(tmp_path / "room", cameras=3)
    run(job(tmp_path / "room", tmp_path / "out"))
    lines = ["camera,frame,seconds", *(f"cam0{c},{i},{i / 30}" for c in range(3) for i in range(2))]
    (tmp_path / "room" / TIMESTAMPS).write_text("\n".join(lines) + "\n")
    again = job(tmp_path / "room", tmp_path / "out", PrepareOptions(synchronize="csv"))
    clocks, _ = run(again)
    assert "synchronize" not in again.steps.skipped
    assert clocks.method == "csv"


def test_another_calibration_is_another_result(room: Path, tmp_path: Path) -> None:
    run(job(room, tmp_path / "out"))
    write_room(tmp_path / "other", cameras=4)
    options = replace(NONE, calibration=tmp_path / "other")
    changed = job(room, tmp_path / "out", options)
    run(changed)
    assert changed.steps.skipped == []
    assert isinstance(chosen_method(changed.find(), options), Calibration)


def test_focal_lengths_that_pictures_state_are_reported(tmp_path: Path) -> None:
    """Pictures of 290 pixels on a diagonal of 400, which is 31.4 mm on film; one camera was held upright."""
    rig, pictures = still_room(3)
    for name in rig:
        exif = Image.Exif()
        exif[0x0112] = 6 if name == "cam02" else 1
        exif.get_ifd(0x8769)[0xA405] = 31
        Image.fromarray(pictures[name]).save(tmp_path / f"{name}.png", exif=exif)
    one = job(tmp_path, tmp_path / "out")
    _, solved = run(one)
    assert list(solved.cameras) == list(rig)
    focals = "began with the focal lengths that the pictures of 3 of 3 cameras state (0.896 of"
    assert focals in one.steps.summaries["calibrate"]
    assert "the files of camera 'cam02' say that pictures are to be turned" in one.steps.summaries["find"]
    again = job(tmp_path, tmp_path / "out")
    run(again)
    assert again.steps.summaries["calibrate"] == one.steps.summaries["calibrate"]


def test_a_calibration_of_two_files_is_read_again_when_the_second_changes(room: Path, tmp_path: Path) -> None:
    """``extri.yml`` alone, as somebody corrects a pose there."""
    videos = tmp_path / "videos"
    videos.mkdir()
    for video in room.glob("*.mp4"):
        (videos / video.name).hardlink_to(video)
    names = sorted(video.stem for video in videos.glob("*.mp4"))
    intri, extri = (["%YAML:1.0", "---", "names:", *(f'  - "{name}"' for name in names)] for _ in range(2))
    for number, name in enumerate(names):
        K = [[150, 0, 80], [0, 150, 60], [0, 0, 1]]
        intri += [opencv_matrix(f"K_{name}", K), opencv_matrix(f"D_{name}", [0.0] * 5)]
        place = np.array([[0.5 * number], [0.0], [0.0]])
        extri += [opencv_matrix(f"R_{name}", 0 * place), opencv_matrix(f"T_{name}", place)]
    (videos / "intri.yml").write_text("\n".join(intri) + "\n")
    (videos / "extri.yml").write_text("\n".join(extri) + "\n")
    _, before = run(job(videos, tmp_path / "out"))
    again = job(videos, tmp_path / "out")
    run(again)
    assert "calibrate" in again.steps.skipped
    (videos / "extri.yml").write_text("\n".join(extri).replace("1.5, 0.0, 0.0", "2.5, 0.0, 0.0") + "\n")
    _, after = run(job(videos, tmp_path / "out"))
    assert float(before.cameras["cam03"].camera.viewmat[0, 3]) == 1.5
    assert float(after.cameras["cam03"].camera.viewmat[0, 3]) == 2.5


NEAR = PrepareOptions(synchronize="none", near=0.25)


def made(where: Path, options: PrepareOptions = NEAR) -> tuple[Footage, SolvedCalibration, PreparedCapture]:
    write_room(where, cameras=4)
    footage = find_footage(where)
    method = chosen_method(footage, options)
    assert not isinstance(method, str)
    solved = given_cameras(method, footage)
    clocks = {name: Clock(0.1 * index) for index, name in enumerate(footage.cameras)}
    return footage, solved, assembled(footage, clocks, solved, options)


def job_of(videos: Path, capture: Path, options: PrepareOptions = NEAR) -> Job:
    found = Job(videos, capture, options, Steps(capture, Silent()))
    found.steps._keys["synchronize"] = "a key"
    return found


def test_the_content_of_a_capture(tmp_path: Path) -> None:
    _, solved, content = made(tmp_path / "videos")
    assert (content.near, content.unit, content.fps) == (0.25, "arbitrary", pytest.approx(30.0))
    assert content.held_out == frozenset()
    for index, (name, camera) in enumerate(content.cameras.items()):
        assert camera.files == f"videos/{name}.mp4"
        assert camera.clock == Clock(0.1 * index)
        assert camera.filmed == solved.cameras[name]
    metric = assembled(find_footage(tmp_path / "videos"), {}, replace(solved, metres=True), replace(NEAR, near=None))
    assert metric.unit == "metres"
    assert metric.near > 0
    assert next(iter(metric.cameras.values())).clock == Clock()
    for held_out, count in ((("cam01", "cam03"), 2), (("auto",), 1)):
        found = assembled(find_footage(tmp_path / "videos"), {}, solved, replace(NEAR, held_out=held_out)).held_out
        assert len(found) == count
        assert count == 1 or found == set(held_out)
    wide = replace(NEAR, field_of_view=40.0, size=(64, 48))
    small = assembled(find_footage(tmp_path / "videos"), {}, solved, wide)
    assert {(one.pinhole.width, one.pinhole.height) for one in small.cameras.values()} == {(64, 48)}


def test_the_rate_of_pictures_is_that_of_most_cameras_by_their_clocks(tmp_path: Path) -> None:
    footage, solved, _ = made(tmp_path / "videos")
    for name in footage.cameras:
        (tmp_path / "stills" / name).mkdir(parents=True)
        shown = next(footage.pictures(name, [0]))
        cv2.imwrite(str(tmp_path / "stills" / name / "0.png"), shown)
    rates = dict(zip(footage.cameras, (1.001, 1.001, 1.001, 1.0), strict=True))
    clocks = {name: Clock(12.0, rate) for name, rate in rates.items()}
    content = assembled(find_footage(tmp_path / "stills"), clocks, solved, NEAR)
    assert content.fps == pytest.approx(30 / 1.001)
    for name, camera in content.cameras.items():
        again = camera.clock.common_seconds(np.arange(9) / content.fps)
        np.testing.assert_allclose(again, 12.0 + rates[name] * np.arange(9) / 30)


def test_files_are_brought_with_their_masks(tmp_path: Path) -> None:
    footage, _, content = made(tmp_path / "videos")
    (tmp_path / "videos" / "masks" / "cam00").mkdir(parents=True)
    (tmp_path / "videos" / "masks" / "cam00" / "0.png").write_bytes(b"mask")
    one = job_of(tmp_path / "videos", tmp_path / "out")
    (tmp_path / "out").mkdir()
    one.link(footage, content)
    for name in content.cameras:
        assert (tmp_path / "out" / "videos" / f"{name}.mp4").samefile(tmp_path / "videos" / f"{name}.mp4")
    assert (tmp_path / "out" / "masks" / "cam00" / "0.png").read_bytes() == b"mask"
    assert read_prepared(tmp_path / "out").near == 0.25
    assert one.steps.summaries["link"] == "4 cameras by hard link or copy"


def test_masks_of_cameras_that_are_left_out_stay_behind(tmp_path: Path) -> None:
    """In the first run, and where an earlier one with these cameras has brought them; what is another's stays."""
    footage, _, content = made(tmp_path / "videos")
    masks, brought = tmp_path / "videos" / "masks", tmp_path / "out" / "masks"
    (masks / "cam01").mkdir(parents=True)
    for name in ("cam00.png", "cam01.png", "cam01/0.png", "cam02.png"):
        (masks / name).write_bytes(name.encode())
    (tmp_path / "out").mkdir()
    job_of(tmp_path / "videos", tmp_path / "out").link(footage, content)
    assert (brought / "cam01" / "0.png").is_file()
    (brought / "cam02.png").unlink()
    (brought / "cam02.png").write_bytes(b"drawn by hand")
    less = replace(NEAR, without=("cam01", "cam02"))
    for _ in range(2):
        job_of(tmp_path / "videos", tmp_path / "out", less).link(footage, content)
        assert sorted(entry.name for entry in brought.iterdir()) == ["cam00.png", "cam02.png"]
    assert sorted(entry.name for entry in masks.iterdir()) == ["cam00.png", "cam01", "cam01.png", "cam02.png"]


def test_another_mask_does_again_what_depends_on_it(tmp_path: Path) -> None:
    one, content = brought(tmp_path)
    assert one.near(content) is content, "a near plane that is given is not looked for"
    assert "near" not in one.steps.summaries
    one.points(content)
    again, content = brought(tmp_path)
    again.points(content)
    assert again.steps.skipped == ["points"]
    (tmp_path / "out" / "masks").mkdir()
    mask = np.full((120, 160), 255, np.uint8)
    mask[:60] = 0
    assert cv2.imwrite(str(tmp_path / "out" / "masks" / "cam00.png"), mask)
    again, content = brought(tmp_path)
    again.points(content)
    assert again.steps.skipped == []


def brought(tmp_path: Path, options: PrepareOptions = NEAR) -> tuple[Job, PreparedCapture]:
    footage, _, content = made(tmp_path / "videos", options)
    content = replace(content, cameras={n: replace(c, clock=Clock()) for n, c in content.cameras.items()})
    one = job_of(tmp_path / "videos", tmp_path / "out", options)
    (tmp_path / "out").mkdir(exist_ok=True)
    one.link(footage, content)
    return one, content


def test_near_plane_and_points_are_kept(tmp_path: Path) -> None:
    options = replace(NEAR, near=None)
    one, content = brought(tmp_path, options)
    near = one.near(content)
    assert near.near > 0
    pointed = one.points(near)
    points = np.load(tmp_path / "out" / POINTS)
    assert points.shape[1] == 3
    assert np.isfinite(points).all()
    assert one.steps.summaries["points"] == f"{len(points):,} points of frame 0"
    written = read_prepared(tmp_path / "out")
    assert (written.near, written.points) == (near.near, POINTS) == (pointed.near, pointed.points)
    again, content = brought(tmp_path, options)
    assert prepared_entries(again.points(again.near(content))) == prepared_entries(pointed)
    assert again.steps.skipped == ["near", "points"]


def test_the_check_is_done_again_when_its_report_is_gone(tmp_path: Path) -> None:
    one, content = brought(tmp_path)
    content = one.points(content)
    findings = one.check(content)
    report = tmp_path / "out" / "report" / "index.html"
    assert report.is_file()
    kept = json.loads((tmp_path / "out" / FOLDER / "check.json").read_text())
    assert len(kept["values"]["findings"]) == len(findings)
    report.unlink()
    again, content = brought(tmp_path)
    assert again.check(again.points(content)) == findings
    assert again.steps.skipped == ["points"]
    assert report.is_file()
    count = f"{len(findings)} finding{'s' * (len(findings) != 1)}"
    assert one.steps.summaries["check"] == f"{count}; report/index.html"


def test_an_interrupted_report_is_written_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where an earlier result fits, as its pictures are no longer those of the folder."""
    one, content = brought(tmp_path)
    one.check(one.points(content))

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    one, content = brought(tmp_path)
    content = one.points(replace(content, near=0.5))
    with monkeypatch.context() as patched:
        patched.setattr("structgstream.preparation.prepare.write_report", interrupt)
        with pytest.raises(KeyboardInterrupt):
            one.check(content)
    again, content = brought(tmp_path)
    again.check(again.points(content))
    assert "check" not in again.steps.skipped
