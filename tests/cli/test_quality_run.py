# SPDX-License-Identifier: Apache-2.0
"""``reconstruct --qualities``: what it writes, what it refuses, how it ends and goes on."""

import json
import os
import signal
from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.cli.progress import Lines
from structgstream.codec.reader import open_stream
from structgstream.codec.segments.quality_list import QUALITIES
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest
from structgstream.session.frame_report import FrameReport
from tests.data.live.test_live_source import files
from tests.support.quick_streams import CLIP, QUARTER, error_of

pytestmark = pytest.mark.usefixtures("quick_tiny")

NAMES = ("low", "high")
GIVEN = ["--sink", "segments", "--qualities", "high=1.5", "low=-2"]


def asked(out: Path, *more: str, frames: int = 3) -> list[str]:
    return ["reconstruct", CLIP, "-o", str(out), "--frames", str(frames), *QUARTER, *GIVEN, *more]


def archived(folder: Path, out: Path) -> bytes:
    assert main(["archive", str(folder), "-o", str(out), "--overwrite"]) == 0
    return out.read_bytes()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of the clip in two qualities."""
    out = tmp_path_factory.mktemp("made") / "out"
    assert main(asked(out)) == 0
    return out


def test_the_list_the_logs_and_the_numbers_lie_beside_the_streams(made: Path) -> None:
    """What is in them: qualities/test_recording.py."""
    values = json.loads(made.with_suffix(".metrics.json").read_text())
    assert (values["state"], [values["qualities"][name]["frames"] for name in NAMES]) == ("finished", [3, 3])
    assert made.with_suffix(".log.jsonl").is_file()
    assert {path.name for path in made.iterdir()} == {QUALITIES, *NAMES, *(f"{name}.log.jsonl" for name in NAMES)}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--quality", "1"], "got --quality besides"),
        (["--mbits", "5"], "got --mbits besides"),
        (["--sink", "file"], "got --sink file; add --sink segments"),
        (["--publish", "s3://bucket/x"], "--publish copies one stream"),
        (["--window", "0"], "--window must be a positive number"),
        (["--qualities", "low=1"], "got 1; for a single one give --quality"),
        (["--preset", "rig"], "got the codec raw; add --preset compact"),
        (["--resume", "--overwrite"], "choose one"),
        (["--record", "take"], "give --live and a rig file"),
    ],
)
def test_options_that_make_no_sense(
    tmp_path: Path, more: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = error_of([*asked(tmp_path / "out"), *more], capsys, status=2)
    assert said in " ".join(error.split())
    assert not (tmp_path / "out" / QUALITIES).exists()


def test_without_a_word_on_segments_it_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["reconstruct", CLIP, "-o", str(tmp_path / "x.sgs"), *QUARTER, "--qualities", "low=-1", "high=1"]
    assert "got no --sink; add --sink segments" in error_of(command, capsys, status=2)
    assert not [*tmp_path.iterdir()]


def test_a_folder_of_something_else_is_left_alone(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}
    for more in (["--resume"], ["--overwrite"]):
        other = [word if word != "low=-2" else "lowest=-2" for word in asked(made, *more)]
        assert "holds the qualities low, high, got lowest, high; give the same" in error_of(other, capsys, status=2)
        one = ["reconstruct", CLIP, "-o", str(made), *QUARTER, "--sink", "segments", *more]
        assert "holds several qualities of one stream" in error_of(one, capsys, status=2)
    finer = [word if word != "low=-2" else "low=-1" for word in asked(made, "--resume")]
    assert "online.rounding.quality differ" in error_of(finer, capsys, status=1)
    assert {path: path.read_bytes() for path in made.rglob("*") if path.is_file()} == before
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "manifest.json").write_text("{}")
    assert "holds one stream, and --qualities writes several" in error_of(asked(tmp_path / "one"), capsys, status=2)


def test_ctrl_c_finishes_the_frame_in_all_and_resume_without_a_word_on_segments_goes_on(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, line = tmp_path / "out", Lines.frame

    def interrupted(self: Lines, report: FrameReport, *, quality: str | None = None) -> None:
        line(self, report, quality=quality)
        if (report.index, quality) == (1, "low"):
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Lines, "frame", interrupted)
        assert main(asked(out)) == 130
    said = capsys.readouterr()
    error = " ".join(said.err.split())
    assert "has 2 of 3 frames in all qualities; continue with the same command and --resume" in error
    lines = [line.split("  ")[:2] for line in said.out.splitlines() if line.startswith("frame ")]
    assert lines == [[f"frame {number}/3", name] for number in (1, 2) for name in NAMES]
    for name in NAMES:
        manifest = read_manifest(FolderStore(out / name))
        assert (manifest.edge.frame, manifest.live) == (1, False)
    error = error_of(asked(out), capsys, status=1)
    assert "contains a stream; continue it with --resume" in error
    assert main([word for word in asked(out, "--resume") if word not in ("--sink", "segments")]) == 0
    assert f"Wrote {out}: low, high" in capsys.readouterr().out.replace("\n", " ")
    for name in NAMES:
        assert archived(out / name, tmp_path / "a.sgs") == archived(made / name, tmp_path / "b.sgs")


def live(out: Path, rig: Path, *more: str) -> int:
    return main(["reconstruct", str(rig), "-o", str(out), "--live", *QUARTER[2:], *GIVEN, *more])


def test_live_cameras_are_read_once_for_all_and_a_resumed_run_goes_on(tmp_path: Path) -> None:
    rig, out = files(tmp_path, frames=60), tmp_path / "out"
    assert live(out, rig, "--frames", "2", "--record", str(tmp_path / "take")) == 0
    assert live(out, rig, "--frames", "4", "--resume") == 0
    readers = [open_stream(out / name) for name in NAMES]
    times = [[(info.index, info.pts_seconds) for info in reader.packets] for reader in readers]
    assert times[0] == times[1]
    assert len(times[0]) == 4
    assert times[0] == sorted(times[0], key=lambda one: one[1])
    manifests = [read_manifest(FolderStore(out / name)) for name in NAMES]
    captured = [one.edge.captured_unix_seconds for one in manifests]
    assert captured[0] == captured[1]
    assert captured[0] is not None
    assert len([*(tmp_path / "take").glob("*.ts")]) == 3
    last = json.loads((tmp_path / "out.log.jsonl").read_text().splitlines()[-1])
    assert set(last["qualities"]) == set(NAMES)
    assert set(last["run"]["live"]["cameras"]) == {"a", "b", "c"}
