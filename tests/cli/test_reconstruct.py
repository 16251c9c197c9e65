# SPDX-License-Identifier: Apache-2.0
"""The command ``reconstruct``: what it writes, what it refuses, and how it goes on."""

import json
import re
from pathlib import Path

import pytest

from structgstream import recorder
from structgstream.cli import main
from structgstream.cli.progress import Lines
from structgstream.codec.reader import open_stream
from structgstream.session.loop import FrameReport
from structgstream.training.parameters import RoundingConfig
from tests.support.quick_streams import CLIP, QUARTER, QUICK, SMALL, Runner

pytestmark = pytest.mark.usefixtures("quick_presets")


def test_reconstruct_writes_the_log_beside_the_stream(stream: Path) -> None:
    entries = [json.loads(line) for line in stream.with_suffix(".log.jsonl").read_text().splitlines()]
    assert [entry["index"] for entry in entries] == [0, 1, 2]
    assert [entry["kind"] for entry in entries] == ["key", "delta", "delta"]
    assert all(entry["total_seconds"] == entry["seconds"]["total"] > 0 for entry in entries)
    assert all(entry["peak_memory_bytes"] == max(entry["peak_memory_bytes_by_stage"].values()) for entry in entries)
    stages = [[*entry["peak_memory_bytes_by_stage"]] for entry in entries]
    assert stages == [["read", "fit", "store", "prepare"], *2 * [["read", "fit", "store"]]]
    assert all(entry["peak_memory_bytes"] > 1e6 for entry in entries)
    assert {entry["peak_memory_kind"] for entry in entries} <= {"stage", "process"}


def test_a_rig_that_is_not_the_papers_is_reported(tmp_path: Path, run: Runner) -> None:
    asked = ["reconstruct", CLIP, "-o", str(tmp_path / "s.sgs"), "--frames", "1", "--scale", "0.25", *QUICK]
    said = " ".join(run([*asked, "--preset", "paper-meetroom"]).out.split())
    assert "The paper's data of paper-meetroom are others: pictures of 80x60 instead of 1280x720;" in said


def test_few_cameras_are_told_at_the_start_what_to_expect(tmp_path: Path, run: Runner) -> None:
    asked = ["reconstruct", CLIP, "--frames", "1", "--scale", "0.25", *QUICK, "-o"]
    assert "degrees apart" not in run([*asked, str(tmp_path / "s.sgs")]).out
    most = ["cam00", "cam02", "cam03", "cam04"]
    first, second, *_ = run([*asked, str(tmp_path / "few.sgs"), "--held-out", *most]).out.splitlines()
    assert "2 training cameras" in first
    assert second.startswith("Warning: 2 cameras, about 59 degrees apart: expect 19 to 24 dB at ")
    assert "at viewpoints between them, where people and objects may be torn (" in second


def test_quality_and_rate_reach_the_stream(tmp_path: Path) -> None:
    base = ["reconstruct", CLIP, "-o", str(tmp_path / "s.sgs"), "--scale", "0.25", "--frames", "1", *QUICK]
    assert main([*base, "--codec", "compact", "--quality", "1.5", "--mbits", "0.5"]) == 0
    header = open_stream(tmp_path / "s.sgs").header
    rounding = header.config["online"]["rounding"]
    assert rounding["quality"] == 1.5
    assert header.steps["free_log_scales"] == pytest.approx(RoundingConfig.FREE_LOG_SCALE_STEP / 2**1.5)
    assert header.config["rate"] == {"target_mbits": 0.5}


def test_an_existing_stream_is_not_replaced_by_accident(stream: Path, run: Runner) -> None:
    before = stream.read_bytes()
    error = run(["reconstruct", CLIP, "-o", str(stream), *SMALL, *QUICK], status=1).err
    assert "--resume" in error
    assert "--overwrite" in error
    assert stream.read_bytes() == before


def test_resuming_with_another_configuration_changes_nothing(stream: Path, run: Runner) -> None:
    before = stream.read_bytes()
    arguments = ["reconstruct", CLIP, "-o", str(stream), *SMALL, *QUICK, "--resume", "--online.losses.ssim", "0.3"]
    assert "online.losses.ssim" in run(arguments, status=1).err
    assert stream.read_bytes() == before


def test_ctrl_c_keeps_whole_frames_and_resume_gives_the_same_file(
    stream: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner
) -> None:
    def interrupted(self: Lines, report: FrameReport, *, quality: str | None = None) -> None:
        if report.index == 1:
            raise KeyboardInterrupt

    path = tmp_path / "again.sgs"
    arguments = ["reconstruct", CLIP, "-o", str(path), *SMALL, *QUICK]
    with monkeypatch.context() as patch:
        patch.setattr(Lines, "frame", interrupted)
        error = run(arguments, status=130).err
    assert "again.sgs" in error
    assert "--resume" in error
    assert path.stat().st_size < stream.stat().st_size
    assert main([*arguments, "--resume"]) == 0
    assert path.read_bytes() == stream.read_bytes()
    assert len(path.with_suffix(".log.jsonl").read_text().splitlines()) == 3


def test_every_second_frame_is_resumed(tmp_path: Path, run: Runner) -> None:
    """Which frames it is scored against: evaluation/test_recording.py."""
    path, whole = tmp_path / "half.sgs", tmp_path / "whole.sgs"
    base = ["reconstruct", CLIP, *QUARTER, "--start", "1", "--every", "2"]
    assert main([*base, "-o", str(whole), "--frames", "2"]) == 0
    first = open_stream(whole).packets[0]
    path.write_bytes(whole.read_bytes()[: first.offset + first.bytes])
    for other in (["--every", "3"], ["--every", "1"]):
        error = run([*base, *other, "-o", str(path), "--frames", "2", "--resume"], status=1).err
        assert "every, fps differ" in error
    assert main([*base, "-o", str(path), "--frames", "2", "--resume"]) == 0
    assert path.read_bytes() == whole.read_bytes()
    with open_stream(path) as reader:
        assert reader.header.fps == 15.0
        assert [info.index for info in reader.packets] == [0, 1]
        assert [info.pts_seconds for info in reader.packets] == pytest.approx([0, 1 / 15])


@pytest.mark.parametrize(
    ("extra", "status", "words"),
    [
        (["--preset", "tny"], 2, "there is no preset 'tny'; there are paper-n3dv"),
        (["--resume", "--overwrite"], 2, "choose one"),
        (["--seed", "-1"], 2, "seed is -1; expected 0 or more."),
        (["--near", "inf"], 1, "The near plane must be positive, got inf"),
        (["--preset", "tiny", "--online.iteration", "5"], 2, "--online.iterations"),
        (["--preset", "tiny", "--online.iterations", "many"], 2, "many"),
        (["--preset", "tiny", "--held-out", "cam77"], 1, "cam77"),
        (["--preset", "tiny", "--scale", "3"], 1, "(0, 1]"),
        (["--preset", "tiny", "--start", "12"], 1, "12 frames"),
        (["--preset", "tiny", "--every", "0"], 1, "(--every) must be at least 1, got 0"),
        (["--preset", "tiny", "--every", "2", "--frames", "7"], 1, "has 12 frames; got start 0 and 7 frames, counting"),
        (["--preset", "rig", "--quality", "1"], 2, "--quality is for streams with the codec compact; the preset 'rig'"),
        (
            ["--preset", "motion", "--mbits", "5"],
            2,
            "--mbits is for streams with the codec compact; the preset 'motion'",
        ),
        (["--preset", "compact", "--codec", "raw", "--mbits", "5"], 2, "Add --preset compact"),
        (["--preset", "compact", "--quality", "90"], 2, "--quality 90 is not one of -6 to 6"),
        (["--preset", "compact", "--quality", "nan"], 2, "--quality nan is not one of"),
        (["--preset", "compact", "--mbits", "0"], 2, "--mbits 0 is no rate"),
        (["--preset", "compact", "--mbits", "inf"], 2, "--mbits inf is no rate"),
        (["--preset", "compact", "--mbits", "5M"], 2, "5M"),
        (["--online.births.missing-threshold", "1"], 2, "--online.births.missing-threshold"),
    ],
)
def test_wrong_options_are_reported_before_anything_is_written(
    tmp_path: Path, extra: list[str], status: int, words: str, run: Runner
) -> None:
    out = tmp_path / "new.sgs"
    assert words in run(["reconstruct", CLIP, "-o", str(out), *extra], status=status).err
    assert not out.exists()


@pytest.mark.parametrize("given", [["--preset", "fast"], ["--preset=fast"], ["--preset", "rig", "--preset=fast"]])
def test_the_configuration_has_help_of_its_own(given: list[str], run: Runner) -> None:
    from structgstream.session.presets import DEFAULT_PRESET, PRESETS

    head, _, *lines = run(["reconstruct", *given, "--help-config"]).out.splitlines()
    assert "'fast'" in head
    assert len(lines) <= 100, "two screens"
    assert all(re.match(r"--[a-z0-9.-]+ \S.* {2,}\S", line) for line in lines), "option, value and sentence"
    ours, default = (PRESETS[name].initial.iterations for name in ("fast", DEFAULT_PRESET))
    (shown,) = (line for line in lines if line.startswith("--initial.iterations "))
    assert shown.split()[1] == str(ours) != str(default)


@pytest.mark.parametrize("given", [["--preset", "tny"], ["--preset=tny"], ["--preset"]])
def test_a_wrong_preset_has_no_help(given: list[str], run: Runner) -> None:
    error = run(["reconstruct", "--help-config", *given], status=2).err
    assert error.count("\n") == 1
    assert "preset" in error


def test_the_presets_named_in_help_are_those_there_are(run: Runner) -> None:
    from structgstream.session.presets import PRESETS

    text = run(["reconstruct", "--help"]).out
    assert all(name in text for name in PRESETS)


def test_the_check_before_the_first_frame_sees_a_folder_without_permission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner
) -> None:
    monkeypatch.setattr(recorder.os, "access", lambda path, mode: False)  # root may write anywhere
    assert "permission" in run(["reconstruct", CLIP, "-o", str(tmp_path / "x.sgs")], status=1).err
