# SPDX-License-Identifier: Apache-2.0
"""Every command on a tiny stream of the bundled clip, and what they say when something is wrong."""

import base64
import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import av
import pytest

from backends import QUICKEST
from drawn import pixels_of
from small_presets import few_points
from structgstream import recorder
from structgstream.cli import main, render
from structgstream.cli.progress import Lines
from structgstream.codec.reader import open_stream
from structgstream.data.clip import bundled_clip_path
from structgstream.session import FrameReport

CLIP = str(bundled_clip_path())
SMALL = ["--frames", "3", "--scale", "0.25"]
QUICK = ["--preset", "tiny", "--device", QUICKEST, "--initial.iterations", "3", "--online.iterations", "2"]
QUICK += ["--online.patching.iteration", "1"]


@pytest.fixture(scope="module", autouse=True)
def quick_presets() -> Iterator[None]:
    with few_points("tiny", "paper-meetroom"):
        yield


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of 80x60 pixels, hardly trained."""
    path = tmp_path_factory.mktemp("stream") / "clip.sgs"
    assert main(["reconstruct", CLIP, "-o", str(path), *SMALL, *QUICK]) == 0
    return path


def error_of(arguments: list[str], capsys: pytest.CaptureFixture[str], *, status: int) -> str:
    """What a command that fails with ``status`` says; never a traceback."""
    capsys.readouterr()
    assert main(arguments) == status
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


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


def test_evaluate_reads_the_file(stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    numbers, folder = tmp_path / "numbers.json", tmp_path / "report"
    arguments = ["evaluate", str(stream), CLIP, "--json", str(numbers), "--report", str(folder)]
    assert main([*arguments, "--device", QUICKEST]) == 0
    content = json.loads(numbers.read_text())
    assert list(content["cameras"]) == ["cam00"]
    assert len(content["frames"]) == 3
    assert 8 < content["mean"]["psnr"] < 40
    assert content["mean"]["seconds"] > 0
    assert content["stream"]["total_bytes"] == stream.stat().st_size
    assert content["stream"]["metadata"]["scale"] == 0.25
    assert content["environment"]["backend"] == QUICKEST
    assert {entry.name for entry in folder.iterdir()} == {"report.json", "over_time.png", "contact_sheet.png"}
    assert json.loads((folder / "report.json").read_text())["mean"]["psnr"] == content["mean"]["psnr"]
    table = capsys.readouterr().out
    headline, beside = (f"{content['mean'][name]:.2f}" for name in ("psnr", "psnr_camera_color"))
    assert re.search(rf"mean +{headline} +{beside} ", table)
    assert "with the header shared over them" in " ".join(table.split())
    assert max(len(line) for line in table.splitlines() if str(folder) not in line) <= 80


def test_evaluate_says_what_it_could_not_measure(
    stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STRUCTGSTREAM_LPIPS_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    evaluate = ["evaluate", str(stream), CLIP, "--device", QUICKEST]
    assert main(evaluate) == 0
    table = " ".join(capsys.readouterr().out.split())
    assert "lpips_alex, t_lpips: the weights of AlexNet were not found" in table
    assert "ms_ssim: pictures need 161 pixels a side" in table
    assert "tFLIP" in table
    assert main([*evaluate, "--metrics", "basic"]) == 0
    table = capsys.readouterr().out
    assert "tFLIP" not in table
    assert "not available" not in table
    nowhere = [*evaluate, "--lpips-weights", str(tmp_path / "none")]
    assert "none, where the path given has the weights" in error_of(nowhere, capsys, status=1)


def test_inspect_lists_header_and_packets(stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(stream), "--json", str(tmp_path / "i.json")]) == 0
    content = json.loads((tmp_path / "i.json").read_text())
    assert set(content) == {"header", "packets"}
    header = content["header"]
    assert header["complete"]
    assert header["config"]["initial"]["iterations"] == 3
    assert header["cameras"]["cam00"]["held_out"]
    scales = header["fields"]["base_scales"]
    assert 0 < scales["bytes"] < 4 * math.prod(scales["shape"]), "coded"
    assert header["metadata"] == {"capture": "clip", "preset": "tiny", "start": 0, "scale": 0.25}
    assert [packet["kind"] for packet in content["packets"]] == ["key", "delta", "delta"]
    assert set(content["packets"][0]) == {
        "kind", "index", "pts_seconds", "offset", "bytes", "fields", "changes", "counts"
    }  # fmt: skip
    assert sum(packet["bytes"] for packet in content["packets"]) + header["header_bytes"] < stream.stat().st_size
    text = capsys.readouterr().out
    assert "complete" in text
    assert "held out: cam00" in text


def test_inspect_prints_the_resolved_configuration(stream: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["inspect", str(stream), "--config"]) == 0
    assert json.loads(capsys.readouterr().out)["online"]["iterations"] == 2


def test_inspect_of_a_cut_file_says_so(stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut, last = tmp_path / "cut.sgs", open_stream(stream).packets[-1]
    cut.write_bytes(stream.read_bytes()[: last.offset + last.bytes // 2])
    assert main(["inspect", str(cut)]) == 0
    assert "not finished" in capsys.readouterr().out


def test_render_a_camera_to_video_and_pictures(stream: Path, tmp_path: Path) -> None:
    base = ["render", str(stream), "--device", QUICKEST, "-o"]
    assert main([*base, str(tmp_path / "v.mp4")]) == 0
    with av.open(str(tmp_path / "v.mp4")) as container:
        assert len(list(container.decode(video=0))) == 3
    assert main([*base, str(tmp_path / "all"), "--camera", "cam03"]) == 0
    assert sorted(entry.name for entry in (tmp_path / "all").iterdir()) == ["00000.png", "00001.png", "00002.png"]
    assert main([*base, str(tmp_path / "one.png"), "--camera", "cam03", "--frame", "1"]) == 0
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "all" / "00001.png").read_bytes()


@pytest.mark.parametrize("path", ["orbit", "arc"])
def test_render_a_path_beside_the_stream(stream: Path, tmp_path: Path, path: str) -> None:
    copy = tmp_path / "ball.sgs"
    shutil.copy(stream, copy)
    assert main(["render", str(copy), "--path", path, "--seconds", "0.2", "--device", QUICKEST]) == 0
    with av.open(str(tmp_path / f"ball-{path}.mp4")) as container:
        assert len(list(container.decode(video=0))) == 6


def test_render_beside_the_truth(stream: Path, tmp_path: Path) -> None:
    out = tmp_path / "side.png"
    arguments = ["render", str(stream), CLIP, "--compare", "--frame", "2", "-o", str(out), "--device", QUICKEST]
    assert main(arguments) == 0
    assert pixels_of(out).shape == (60, 3 * 80 + 8, 3)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--camera", "cam99"], "no camera 'cam99'"),
        (["--frame", "7", "-o", "x.png"], "frames 0 to 2"),
        (["-o", "x.png"], "--frame"),
        (["--compare"], "needs the capture"),
        (["--between", "cam01", "cam02"], "--path arc"),
        ([CLIP], "only used with --compare"),
    ],
)
def test_render_refuses_what_does_not_go_together(
    stream: Path, extra: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert words in error_of(["render", str(stream), *extra, "--device", QUICKEST], capsys, status=2)


def test_demo_leaves_everything_to_look_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(render, "LEAST_PATH_SECONDS", 0.1)
    out = tmp_path / "demo"
    assert main(["demo", "--output", str(out), "--frames", "2", "--scale", "0.25", *QUICK]) == 0
    made = {str(entry.relative_to(out)) for entry in out.rglob("*") if entry.is_file()}
    report = {"report/report.json", "report/over_time.png", "report/contact_sheet.png"}
    assert made == {"clip.sgs", "clip.log.jsonl", "held-out.mp4", "orbit.mp4", "player.html"} | report
    text = capsys.readouterr().out
    assert re.search(r"Held-out PSNR [\d.]+ dB \([\d.]+ after frame 0's colour fit\)", text)
    assert all(name.split("/")[-1] in text for name in made - {"clip.log.jsonl"})
    assert (out / "player.html").as_uri() in text
    assert f"structgstream play {out / 'clip.sgs'} --capture {CLIP}" in text
    assert base64.b64encode((out / "clip.sgs").read_bytes()) in (out / "player.html").read_bytes()


def test_a_rig_that_is_not_the_papers_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["reconstruct", CLIP, "-o", str(tmp_path / "s.sgs"), "--frames", "1", "--scale", "0.25", *QUICK]
    assert main([*asked, "--preset", "paper-meetroom"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "The paper's data of paper-meetroom are others: pictures of 80x60 instead of 1280x720;" in said


def test_quality_and_rate_reach_the_stream(tmp_path: Path) -> None:
    base = ["reconstruct", CLIP, "-o", str(tmp_path / "s.sgs"), "--scale", "0.25", "--frames", "1", *QUICK]
    assert main([*base, "--codec", "compact", "--quality", "1.5", "--mbits", "0.5"]) == 0
    header = open_stream(tmp_path / "s.sgs").header
    rounding = header.config["online"]["rounding"]
    assert rounding["quality"] == 1.5
    assert header.steps["free_log_scales"] == pytest.approx(rounding["free_log_scale_step"] / 2**1.5)
    assert header.config["rate"] == {"target_mbits": 0.5, "window_seconds": 1.0}


def test_an_existing_stream_is_not_replaced_by_accident(stream: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = stream.read_bytes()
    error = error_of(["reconstruct", CLIP, "-o", str(stream), *SMALL, *QUICK], capsys, status=1)
    assert "--resume" in error
    assert "--overwrite" in error
    assert stream.read_bytes() == before


def test_resuming_with_another_configuration_changes_nothing(stream: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = stream.read_bytes()
    arguments = ["reconstruct", CLIP, "-o", str(stream), *SMALL, *QUICK, "--resume", "--online.losses.ssim", "0.3"]
    assert "online.losses.ssim" in error_of(arguments, capsys, status=1)
    assert stream.read_bytes() == before


def test_ctrl_c_keeps_whole_frames_and_resume_gives_the_same_file(
    stream: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(self: Lines, report: FrameReport) -> None:
        if report.index == 1:
            raise KeyboardInterrupt

    path = tmp_path / "again.sgs"
    arguments = ["reconstruct", CLIP, "-o", str(path), *SMALL, *QUICK]
    with monkeypatch.context() as patch:
        patch.setattr(Lines, "frame", interrupted)
        error = error_of(arguments, capsys, status=130)
    assert "again.sgs" in error
    assert "--resume" in error
    assert path.stat().st_size < stream.stat().st_size
    assert main([*arguments, "--resume"]) == 0
    assert path.read_bytes() == stream.read_bytes()
    assert len(path.with_suffix(".log.jsonl").read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("extra", "status", "words"),
    [
        (["--preset", "tny"], 2, "there is no preset 'tny'; there are paper-n3dv"),
        (["--resume", "--overwrite"], 2, "choose one"),
        (["--preset", "tiny", "--online.iteration", "5"], 2, "--online.iterations"),
        (["--preset", "tiny", "--online.iterations", "many"], 2, "many"),
        (["--preset", "tiny", "--held-out", "cam77"], 1, "cam77"),
        (["--preset", "tiny", "--scale", "3"], 1, "(0, 1]"),
        (["--preset", "tiny", "--start", "12"], 1, "12 frames"),
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
    ],
)
def test_wrong_options_are_told_before_anything_is_written(
    tmp_path: Path, extra: list[str], status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new.sgs"
    assert words in error_of(["reconstruct", CLIP, "-o", str(out), *extra], capsys, status=status)
    assert not out.exists()


def test_paths_that_cannot_work_are_told(stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new = str(tmp_path / "new.sgs")
    assert "does not exist" in error_of(["reconstruct", str(tmp_path / "no"), "-o", new], capsys, status=1)
    assert "is a folder" in error_of(["reconstruct", CLIP, "-o", str(tmp_path)], capsys, status=1)
    assert "cannot be created" in error_of(["reconstruct", CLIP, "-o", str(stream / "x" / "y")], capsys, status=1)
    assert str(tmp_path / "no") in error_of(["inspect", str(tmp_path / "no")], capsys, status=1)
    (tmp_path / "text").write_text("hello, this is no stream at all")
    assert "text" in error_of(["evaluate", str(tmp_path / "text"), CLIP], capsys, status=1)
    assert "is a file" in error_of(["demo", "--output", str(stream)], capsys, status=2)


@pytest.mark.parametrize("given", [["--preset", "fast"], ["--preset=fast"], ["--preset", "rig", "--preset=fast"]])
def test_the_configuration_has_help_of_its_own(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    from structgstream.presets import DEFAULT_PRESET, PRESETS

    assert main(["reconstruct", *given, "--help-config"]) == 0
    text = capsys.readouterr().out
    assert "--online.patching.grad-threshold" in text
    assert "'fast'" in text
    ours, default = (PRESETS[name].initial.iterations for name in ("fast", DEFAULT_PRESET))
    shown = text[text.index("--initial.iterations") :].split("default: ")[1]
    assert shown.startswith(f"{ours})")
    assert ours != default


@pytest.mark.parametrize("given", [["--preset", "tny"], ["--preset=tny"], ["--preset"]])
def test_a_wrong_preset_has_no_help(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of(["reconstruct", "--help-config", *given], capsys, status=2)
    assert error.count("\n") == 1
    assert "preset" in error


def test_the_presets_named_in_help_are_those_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    from structgstream.presets import PRESETS

    assert main(["reconstruct", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in PRESETS)


def test_exit_status_of_the_program(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "structgstream", "export", str(tmp_path / "no.sgs"), "--format", "html"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


def test_the_check_before_the_first_frame_sees_a_folder_without_permission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(recorder.os, "access", lambda path, mode: False)  # root may write anywhere
    assert "permission" in error_of(["reconstruct", CLIP, "-o", str(tmp_path / "x.sgs")], capsys, status=1)


@pytest.mark.parametrize(("count", "frames"), [(6, [0, 1, 1, 2, 1, 1]), (2, [0, 1])])
def test_time_on_a_path_runs_forth_and_back(count: int, frames: list[int]) -> None:
    class Reader:
        packets = (0, 1, 2)

        def scenes(self, start: int) -> list[tuple[int, int]]:
            return [(i, i) for i in self.packets[start:]]

    assert list(render._ping_pong(Reader(), None, count=count)) == frames  # pyright: ignore
