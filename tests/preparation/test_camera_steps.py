# SPDX-License-Identifier: Apache-2.0
"""The steps up to a calibration: what each depends on, and what is done again."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from structgstream.data.calibration import Calibration
from structgstream.errors import CalibrationError, ConfigError
from structgstream.preparation.calibration.solved import SolvedCalibration
from structgstream.preparation.options import Distance, PrepareOptions
from structgstream.preparation.output_folder import FOLDER, SOURCE, Silent, Steps
from structgstream.preparation.prepare import Job, chosen_method
from structgstream.preparation.solvers import TIMESTAMPS, Clocks
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
    ("options", "purpose"),
    [
        (replace(NONE, without=("nobody",)), "leave out"),
        (replace(NONE, held_out=("nobody",)), "hold out"),
        (replace(NONE, held_out=("cam00",), without=("cam00",)), "hold out"),
        (replace(NONE, distance=Distance("cam00", "nobody", 1.0)), "measure from"),
    ],
)
def test_cameras_that_are_not_there_cost_no_time(
    room: Path, tmp_path: Path, options: PrepareOptions, purpose: str
) -> None:
    with pytest.raises(ConfigError, match=f"has no camera .* to {purpose}; its cameras are cam0"):
        job(room, tmp_path / "out", options).find()
    assert not (tmp_path / "out").exists()


def test_too_many_held_out_cost_no_time(room: Path, tmp_path: Path) -> None:
    options = replace(NONE, held_out=("cam00", "cam01", "cam02"))
    with pytest.raises(ConfigError, match="4 cameras, 3 of them held out; a reconstruction needs 2 or more"):
        job(room, tmp_path / "out", options).find()
    assert not (tmp_path / "out").exists()
    job(room, tmp_path / "out", replace(NONE, held_out=("cam00", "cam01"))).find()


def test_too_few_cameras_claim_nothing(room: Path, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="needs 3 or more"):
        job(room, tmp_path / "out", replace(NONE, without=("cam00", "cam01"))).find()
    assert not (tmp_path / "out").exists()


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
        intri += matrix(f"K_{name}", 3, (150, 0, 80, 0, 150, 60, 0, 0, 1)) + matrix(f"D_{name}", 5, (0.0,) * 5)
        extri += matrix(f"R_{name}", 1, (0.0,) * 3) + matrix(f"T_{name}", 1, (0.5 * number, 0.0, 0.0))
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


def matrix(key: str, columns: int, values: Sequence[float]) -> list[str]:
    """A matrix as OpenCV's storage writes it; one column for vectors."""
    rows, columns = (len(values) // columns, columns) if columns > 1 else (len(values), 1)
    data = ", ".join(str(float(value)) for value in values)
    return [
        f"{key}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d", f"   data: [ {data} ]",
    ]  # fmt: skip
