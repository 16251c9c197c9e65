# SPDX-License-Identifier: Apache-2.0
"""The steps from a calibration to a capture."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from structgstream.data.prepared import PreparedCapture, prepared_entries, read_prepared
from structgstream.data.timeline import Clock
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.output_folder import FOLDER, Silent, Steps
from structgstream.preparation.prepare import POINTS, Job, assembled, chosen_method
from structgstream.preparation.solvers import given_cameras
from tests.support.rooms import write_room

NONE = PrepareOptions(synchronize="none", near=0.25)


def made(where: Path, options: PrepareOptions = NONE) -> tuple[Footage, SolvedCalibration, PreparedCapture]:
    write_room(where, cameras=4)
    footage = find_footage(where)
    method = chosen_method(footage, options)
    assert not isinstance(method, str)
    solved = given_cameras(method, footage)
    clocks = {name: Clock(0.1 * index) for index, name in enumerate(footage.cameras)}
    return footage, solved, assembled(footage, clocks, solved, options)


def job(videos: Path, capture: Path, options: PrepareOptions = NONE) -> Job:
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
    metric = assembled(find_footage(tmp_path / "videos"), {}, replace(solved, metres=True), replace(NONE, near=None))
    assert metric.unit == "metres"
    assert metric.near > 0
    assert next(iter(metric.cameras.values())).clock == Clock()
    wide = replace(NONE, field_of_view=40.0, size=(64, 48))
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
    content = assembled(find_footage(tmp_path / "stills"), clocks, solved, NONE)
    assert content.fps == pytest.approx(30 / 1.001)
    for name, camera in content.cameras.items():
        again = camera.clock.common_seconds(np.arange(9) / content.fps)
        np.testing.assert_allclose(again, 12.0 + rates[name] * np.arange(9) / 30)


def test_who_is_held_out(tmp_path: Path) -> None:
    _, _, content = made(tmp_path / "videos", replace(NONE, held_out=("cam01", "cam03")))
    assert content.held_out == {"cam01", "cam03"}
    _, _, content = made(tmp_path / "videos", replace(NONE, held_out=("auto",)))
    assert len(content.held_out) == 1


def test_files_are_brought_with_their_masks(tmp_path: Path) -> None:
    footage, _, content = made(tmp_path / "videos")
    (tmp_path / "videos" / "masks" / "cam00").mkdir(parents=True)
    (tmp_path / "videos" / "masks" / "cam00" / "0.png").write_bytes(b"mask")
    one = job(tmp_path / "videos", tmp_path / "out")
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
    job(tmp_path / "videos", tmp_path / "out").link(footage, content)
    assert (brought / "cam01" / "0.png").is_file()
    (brought / "cam02.png").unlink()
    (brought / "cam02.png").write_bytes(b"drawn by hand")
    less = replace(NONE, without=("cam01", "cam02"))
    for _ in range(2):
        job(tmp_path / "videos", tmp_path / "out", less).link(footage, content)
        assert sorted(entry.name for entry in brought.iterdir()) == ["cam00.png", "cam02.png"]
    assert sorted(entry.name for entry in masks.iterdir()) == ["cam00.png", "cam01", "cam01.png", "cam02.png"]


def test_another_mask_does_again_what_depends_on_it(tmp_path: Path) -> None:
    one, content = brought(tmp_path)
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


def test_a_near_plane_that_is_given_is_not_looked_for(tmp_path: Path) -> None:
    _, _, content = made(tmp_path / "videos")
    one = job(tmp_path / "videos", tmp_path / "out")
    assert one.near(content) is content
    assert "near" not in one.steps.summaries


def brought(tmp_path: Path, options: PrepareOptions = NONE) -> tuple[Job, PreparedCapture]:
    footage, _, content = made(tmp_path / "videos", options)
    content = replace(content, cameras={n: replace(c, clock=Clock()) for n, c in content.cameras.items()})
    one = job(tmp_path / "videos", tmp_path / "out", options)
    (tmp_path / "out").mkdir(exist_ok=True)
    one.link(footage, content)
    return one, content


def test_near_plane_and_points_are_kept(tmp_path: Path) -> None:
    options = replace(NONE, near=None)
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
