# SPDX-License-Identifier: Apache-2.0
"""Mistakes made in a rig whose truth is known, what the check says of each, and the check of a folder."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from structgstream.cameras import CameraRig
from structgstream.errors import CaptureError, StorageError
from structgstream.frames import MultiViewFrame
from structgstream.pose_check.check import Finding, explain
from structgstream.pose_check.tracks import gather
from structgstream.pose_check.verdicts import judge
from structgstream.preparation.checking.check import Checked, CheckReport, check_capture
from structgstream.preparation.prepare import check_folder
from tests.support.evidence_made import Cameras, farther, turned
from tests.support.memory_captures import MemoryCapture
from tests.support.planes import room_frame, room_rig
from tests.support.quick_preparation import Heard
from tests.support.rooms import write_room


@cache
def room() -> tuple[CameraRig, MultiViewFrame]:
    """Large enough pictures for keypoints; exposures as the cameras of ``planes`` have them."""
    rig = room_rig(8)
    return rig, room_frame(rig)


def checked(change: Callable[[Cameras], object] | None = None, **known: object) -> Checked:
    rig, frame = room()
    cameras = dict(rig.cameras)
    if change is not None:
        change(cameras)
    source = MemoryCapture(rig.mapped(cameras), [frame], **known)  # type: ignore[arg-type]
    return check_capture(source, unit="metres")


def errors_of(report: CheckReport) -> list[Finding]:
    return [finding for finding in report.findings if finding.severity == "error"]


def errors(check: Checked) -> list[str]:
    return [finding.sentence for finding in errors_of(check.report)]


def test_a_good_rig_is_fine() -> None:
    check = checked()
    assert not errors(check)
    report = check.report
    assert report.median_epipolar_pixels is not None
    assert report.median_epipolar_pixels < 0.5
    assert report.coverage.points > 50
    assert report.coverage.seen_by_three > 0.9
    assert report.nearest is not None
    assert 1.5 < report.nearest < 2.6  # the board stands 2.5 in front of the cameras
    for camera in report.cameras.values():
        assert camera.reprojection_pixels is not None
        assert camera.reprojection_pixels < 0.7
        assert camera.overlaps >= 3


def test_cameras_that_are_too_far_apart_are_told_what_to_expect() -> None:
    rig, frame = room()
    assert not any("degrees apart" in finding.sentence for finding in checked().report.findings)
    far = rig.with_held_out(frozenset([*rig][1:-1]))
    found = check_capture(MemoryCapture(far, [frame])).report.findings
    assert [f.severity for f in found if f.sentence.startswith("2 cameras, about 45 degrees apart")] == ["warning"]


def test_the_camera_that_was_turned_is_named() -> None:
    def bump(cameras: Cameras) -> None:
        cameras["cam02"] = turned(cameras["cam02"], 1.5)

    check = checked(bump)
    (found,) = errors_of(check.report)
    assert found.cameras == ("cam02",)
    assert "Camera 'cam02' is off" in found.sentence
    degrees = float(found.sentence.split("place it ")[1].split(" degrees")[0])
    assert degrees == pytest.approx(1.5, abs=0.35)
    assert check.report.cameras["cam02"].reprojection_pixels > 2  # type: ignore[operator]


def test_points_of_another_unit_are_reported() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.5, -0.4, 0.3], [0.5, 0.6, 1.5], (200, 3))
    assert not errors(checked(points=points))
    (sentence,) = errors(checked(points=1000 * points))
    assert "1000 times too large (millimetres among metres)" in sentence


def test_points_that_were_estimated_with_a_camera_of_another_unit_are_not_reported_beside_it() -> None:
    def mistake(cameras: Cameras) -> None:
        cameras["cam03"] = farther(cameras["cam03"], 1000.0)

    points = 1000 * np.random.default_rng(0).uniform([-0.5, -0.4, 0.3], [0.5, 0.6, 1.5], (200, 3))
    (found,) = errors_of(checked(mistake, points=points).report)
    assert found.cameras == ("cam03",)


def test_exposure_is_measured() -> None:
    """Cameras of ``planes`` have gains of sRGB values; halving one in linear light is a stop."""
    rig, frame = room()
    half = frame.images["cam04"].astype(float) / 255
    linear = np.where(half <= 0.04045, half / 12.92, ((half + 0.055) / 1.055) ** 2.4) / 2
    dark = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    images = {**frame.images, "cam04": (255 * dark).round().astype(np.uint8)}
    before = checked().report.cameras["cam04"].exposure_stops
    after = check_capture(MemoryCapture(rig, [replace(frame, images=images)])).report
    assert before is not None
    assert after.cameras["cam04"].exposure_stops == pytest.approx(before - 1, abs=0.15)
    assert any("Exposure differs" in finding.sentence and "'cam04'" in finding.sentence for finding in after.findings)


def test_a_camera_that_was_bumped_in_between_is_reported() -> None:
    rig, frame = room()
    shifted = {**frame.images, "cam06": np.roll(frame.images["cam06"], (5, 9), axis=(0, 1))}
    source = MemoryCapture(rig, [frame, replace(frame, index=1, images=shifted)])
    (found,) = errors_of(check_capture(source).report)
    assert found.cameras == ("cam06",)
    shift = float(found.sentence.split("shifted by ")[1].split(" pixels")[0])
    assert shift == pytest.approx(np.hypot(5, 9), abs=0.5)


def test_cameras_without_overlap_are_reported() -> None:
    rig, frame = room()
    blind = {name: room_frame(rig, textured=False).images[name] for name in ("cam00", "cam01")}
    check = check_capture(MemoryCapture(rig, [replace(frame, images={**frame.images, **blind})]))
    apart = [finding for finding in check.report.findings if "have no matches" in finding.sentence]
    assert {name for finding in apart for name in finding.cameras} == {"cam00", "cam01"}
    nothing = check_capture(MemoryCapture(rig, [room_frame(rig, textured=False)]))
    assert "enough matches to check their poses" in nothing.report.findings[0].sentence


def test_an_absent_camera_is_left_out() -> None:
    rig, frame = room()
    images = {name: image for name, image in frame.images.items() if name != "cam07"}
    report = check_capture(MemoryCapture(rig, [replace(frame, images=images)])).report
    assert not errors_of(report)
    assert report.cameras["cam07"].points == 0
    assert report.cameras["cam07"].reprojection_pixels is None


def frames_without(absent: dict[str, set[int]], count: int) -> list[MultiViewFrame]:
    _, frame = room()
    return [
        replace(
            frame,
            index=index,
            images={name: image for name, image in frame.images.items() if index not in absent.get(name, set())},
        )
        for index in range(count)
    ]


def test_the_frame_that_is_looked_at_is_one_that_all_cameras_have() -> None:
    rig, _ = room()
    report = check_capture(MemoryCapture(rig, frames_without({"cam07": {0, 1}}, 4))).report
    assert report.frame > 1
    assert report.cameras["cam07"].points > 20
    dropped, start = [finding for finding in report.findings if finding.cameras == ("cam07",)]
    assert (dropped.severity, start.severity) == ("warning", "warning")
    assert "lacks 2 of 4 frames" in dropped.sentence
    assert "has no picture of frame 0" in start.sentence
    assert "begin with frame 2 (--start)" in start.sentence


def test_cameras_without_a_frame_in_common_are_all_looked_at() -> None:
    rig, _ = room()
    report = check_capture(MemoryCapture(rig, frames_without({"cam00": {0, 1}, "cam01": {2, 3}}, 4))).report
    assert not errors_of(report)
    assert all(camera.points > 20 for camera in report.cameras.values())
    message = [finding.sentence for finding in report.findings]
    assert any("Camera 'cam01' ends with frame" in sentence for sentence in message)
    assert any(
        "Camera 'cam00' has no picture of frame 0" in sentence and "no frame has more" in sentence
        for sentence in message
    )


def test_a_few_wrong_matches_are_a_note() -> None:
    """As the check of a camera that shares hardly anything: chance makes 20 to 25 matches that fit some geometry."""
    rig, frame = room()
    found = gather(frame, rig.cameras)
    rng = np.random.default_rng(0)
    matches = {pair: rows for pair, rows in found.matches.items() if "cam02" not in pair}
    some = rng.permutation(len(found.keypoints["cam03"]))[:25]
    matches["cam02", "cam03"] = np.stack([np.arange(25), some], 1)
    keypoints = {**found.keypoints, "cam02": rng.uniform([0, 0], [160, 120], (25, 2))}
    evidence = replace(found, keypoints=keypoints, matches=matches)
    verdict = judge(evidence, rig.cameras)
    assert not verdict.suspects.off
    (note,) = explain(evidence, rig.cameras, verdict)
    assert (note.severity, note.cameras) == ("note", ("cam02",))
    assert "could not be checked: its few matches, with 'cam03' (25, off by" in note.sentence


def test_a_folder_of_any_layout_is_checked_and_reported(tmp_path: Path) -> None:
    write_room(tmp_path / "room")
    heard = Heard()
    checked = check_folder(tmp_path / "room", report=tmp_path / "report", listener=heard)
    assert (tmp_path / "report" / "index.html").is_file()
    assert heard.calls[0] == ("begin", "check", False)
    assert heard.calls[-1] == ("end", "check", f"{len(checked.report.findings)} findings")
    before = sorted(tmp_path.rglob("*"))
    again = check_folder(tmp_path / "room", report=None)
    assert again.report.findings == checked.report.findings
    assert sorted(tmp_path.rglob("*")) == before


def test_a_report_that_cannot_be_written_is_noticed_first(tmp_path: Path) -> None:
    write_room(tmp_path / "room")
    (tmp_path / "file").write_text("")
    heard = Heard()
    with pytest.raises(StorageError, match="report of a check"):
        check_folder(tmp_path / "room", report=tmp_path / "file" / "report", listener=heard)
    assert heard.calls == [("begin", "check", False)]


def test_what_is_no_capture(tmp_path: Path) -> None:
    with pytest.raises(CaptureError):
        check_folder(tmp_path, report=tmp_path / "report")
    assert not (tmp_path / "report").exists()
