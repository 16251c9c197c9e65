# SPDX-License-Identifier: Apache-2.0
"""The command ``evaluate``, and numbers as tables for a terminal, from scores that are made up."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import pytest

from structgstream.cli import evaluate
from structgstream.cli.evaluate import quality_text, report_tables
from structgstream.cli.progress import SHOWN_FRAMES
from structgstream.codec.reader import open_stream
from structgstream.data.source import SourceWrapper
from structgstream.evaluation.recording import capture_of
from structgstream.evaluation.report import FrameScores, Report, Scores
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import select_backend
from tests.support.backends import QUICKEST
from tests.support.consoles import console, text
from tests.support.quick_streams import CLIP, Runner
from tests.support.reports import frame_scores


def test_evaluate_reads_the_file(stream: Path, tmp_path: Path, run: Runner) -> None:
    numbers, folder = tmp_path / "numbers.json", tmp_path / "report"
    arguments = ["evaluate", str(stream), CLIP, "--json", str(numbers), "--report", str(folder)]
    table = run([*arguments, "--device", QUICKEST]).out
    content = json.loads(numbers.read_text())
    assert list(content["cameras"]) == ["cam00"]
    assert len(content["frames"]) == 3
    assert 8 < content["mean"]["psnr"] < 40
    assert content["mean"]["seconds"] > 0
    assert content["stream"]["total_bytes"] == stream.stat().st_size
    assert content["stream"]["metadata"]["scale"] == 0.25
    assert content["stream"]["config"]["seed"] == 0
    assert content["environment"]["backend"] == QUICKEST
    assert {entry.name for entry in folder.iterdir()} == {
        "report.json", "index.html", "over_time.png", "contact_sheet.png", "worst"
    }  # fmt: skip
    assert json.loads((folder / "report.json").read_text())["mean"]["psnr"] == content["mean"]["psnr"]
    page = (folder / "index.html").read_text()
    crops = [path.relative_to(folder) for path in (folder / "worst").iterdir()]
    assert len(crops) >= 2
    assert all(f"src='{path}'" in page for path in crops)
    worst = content["stream"]["worst"]["changed"]
    assert worst["psnr_changed"] == min(f["psnr_changed"] for f in content["frames"] if f["psnr_changed"] is not None)
    assert worst["camera"] == "cam00"
    assert content["stream"]["stored_size_frames"] == [2]
    assert [frame["psnr_stored"] is None for frame in content["frames"]] == [True, True, False]
    assert all(8 < frame["psnr_half"] < 45 for frame in content["frames"])
    assert re.search(r"camera +half +SSIM +stored +SSIM +disoccluded %", table)
    headline, beside = (f"{content['mean'][name]:.2f}" for name in ("psnr", "psnr_camera_color"))
    assert re.search(rf"mean +{headline} +{beside} ", table)
    assert "with the header shared over them" in " ".join(table.split())
    assert max(len(line) for line in table.splitlines() if str(folder) not in line) <= 80


def test_a_camera_that_is_absent_from_the_sampled_frames_is_in_the_contact_sheet(
    stream: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @dataclass(frozen=True)
    class Late(SourceWrapper):
        def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
            for frame in self.source.frames(start):
                yield frame if frame.index else replace(frame, images={})

    monkeypatch.setattr(evaluate, "SHEET_COLUMNS", 1)
    backend, folder = select_backend(QUICKEST), tmp_path / "report"
    with open_stream(stream) as reader:
        late = Late(capture_of(reader.header, CLIP, frames=3))
        evaluate.run_evaluation(
            reader, late, stream=stream, backend=backend, cameras=None, folder=folder, metrics="basic"
        )
    assert (folder / "contact_sheet.png").is_file()


def test_evaluate_says_what_it_could_not_measure(
    stream: Path, tmp_path: Path, run: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STRUCTGSTREAM_LPIPS_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    arguments = ["evaluate", str(stream), CLIP, "--device", QUICKEST]
    table = " ".join(run(arguments).out.split())
    assert "lpips_alex, t_lpips: the weights of AlexNet were not found" in table
    assert "ms_ssim: pictures need 161 pixels a side" in table
    assert "tFLIP" in table
    table = run([*arguments, "--metrics", "basic"]).out
    assert "tFLIP" not in table
    assert "not available" not in table
    nowhere = [*arguments, "--lpips-weights", str(tmp_path / "none")]
    assert "none, where the path given has the weights" in run(nowhere, status=1).err


FACTS: dict[str, Any] = {
    "metrics": "all", "not_available": {}, "cameras": {"cam[0]": "held out"}, "absent_frames": {}, "masked_share": {},
    "psnr_first": 31.0, "psnr_last": 30.0, "psnr_worst": 29.5, "drift_db_per_frame": -0.0125,
    "drift_at_equal_shares_db_per_frame": 0.0009, "total_bytes": 5_000_000,
    "header_bytes": 1_000_000, "packet_bytes": 4_000_000, "frames": 4, "megabits_per_second": 240.0,
    "megabits_per_second_with_header": 300.0, "fps": 30.0, "render_fps": 12.34, "decode_and_render_fps": 5.0,
    "worst": {"changed": None, "ghosts": None},
    "field_bytes": {"small": 10, "large": 3_000_000, "none": 0},
}  # fmt: skip
MACHINE = {"gpu": None, "cpu": "a [fast] one", "cores": 2, "backend": "cpu", "torch": "2.0", "peak_memory_bytes": None}


def scores(**known: Any) -> Scores:
    """Scores of 30 dB, and None for what is not ``known``."""
    values: dict[str, Any] = {field.name: None for field in fields(Scores)}
    return Scores(**{**values, "psnr": 30.0, "psnr_affine": 31.5, "ssim": 0.9, **known})


def frame(index: int, *, mean: Scores | None = None, **log: Any) -> FrameScores:
    return frame_scores(index, {}, mean=mean, bytes=1_000_000, anchors=12_345, free=67, log=log)


def report(frames: int = 4, **facts: Any) -> Report:
    of_frames = [frame(i, mean=scores(psnr=20.0 + i), total_seconds=1.25) for i in range(frames)]
    mean = scores(psnr_camera_color=30.5)
    return Report(of_frames, {"cam[0]": mean}, mean, {**FACTS, **facts}, MACHINE)


def shown(of: Report, *, title: str = "ball.sgs") -> str:
    to = console(width=200)
    to.print(report_tables(of, title=title))
    return text(to)


def row(printed: str, first: str) -> list[str]:
    """The words of the line that begins so."""
    return next(line.split() for line in printed.splitlines() if line.strip().startswith(first))


def test_frames_and_their_mean() -> None:
    text = shown(report(), title="[a] ball.sgs")
    assert "[a] ball.sgs" in text
    assert row(text, "0 ")[:2] == ["0", "20.00"]
    assert row(text, "3 ") == ["3", "23.00", "-", "0.9000", "-", "-", "1.0", "MB", "12,345", "67", "1.2"]
    assert row(text, "mean")[:3] == ["mean", "30.00", "30.50"]


@pytest.mark.parametrize("count", [1, 23, 24, 25, 48, 49, 100, 1000])
def test_a_long_stream_is_shown_in_part_with_its_first_and_last_frame(count: int) -> None:
    text = shown(report(count))
    numbers = [int(words[0]) for line in text.splitlines() if len(words := line.split()) > 9 and words[0].isdigit()]
    assert (numbers[0], numbers[-1], numbers) == (0, count - 1, sorted(set(numbers)))
    assert len(numbers) <= SHOWN_FRAMES + 1
    assert len(numbers) == count or len(numbers) > SHOWN_FRAMES / 2


def test_a_frame_without_pictures_or_log() -> None:
    of = report()
    text = shown(replace(of, frames=(of.frames[0], frame(1))))
    assert row(text, "1 ") == ["1", "-", "-", "-", "-", "-", "1.0", "MB", "12,345", "67", "-"]


def test_cameras_with_names_that_look_like_markup() -> None:
    assert row(shown(report()), "cam[0]") == ["cam[0]", "held", "out", "30.00", "30.50", "0.9000", "-", "-", "31.50"]


def test_further_scores_only_where_they_were_asked_for() -> None:
    assert "tFLIP" in shown(report())
    assert "tFLIP" not in shown(report(metrics="basic"))


def test_what_is_missing_and_why_once_a_reason() -> None:
    text = shown(report(not_available={"a": "no weights", "b": "too small", "c": "no weights"}))
    assert text.count("no weights") == 1
    assert "a, c: no weights" in text
    assert "b: too small" in text
    assert "not available" not in shown(report())


def test_facts_of_the_file() -> None:
    text = " ".join(shown(report()).split())
    assert "first 31.00, last 30.00, worst 29.50 dB; drift -0.013 dB a frame" in text
    assert "5.0 MB: header 1.0 MB, 4 packets 4.0 MB; a frame 1.0 MB, 1.2 MB with the header" in text
    assert "240.00 Mbit/s at 30 frames a second, 300.00 with the header" in text
    assert "large 3.0 MB, small 10 B" in text
    assert "none" not in text
    assert "12.3 pictures a second, 5.0 with the decoding" in text
    assert "a [fast] one, 2 cores, back-end cpu, torch 2.0" in text
    for absent in ("absent", "masked", "training", "this evaluation"):
        assert absent not in text


def test_facts_that_only_some_files_have() -> None:
    trained = {"peak_memory_bytes": 10**9, "seconds_first": 61.0, "seconds_online_mean": None}
    of = report(
        absent_frames={"cam1": 2}, masked_share={"cam2": 0.125}, peak_memory_bytes_by_stage={"fit": 10**6}, **trained
    )
    text = " ".join(shown(replace(of, environment={**MACHINE, "gpu": "GPU X", "peak_memory_bytes": 10**6})).split())
    assert "cam1 from 2 of 4 frames; means are over the pictures that exist" in text
    assert "cam2 12.5% of the pixels, which are not scored" in text
    assert "first frame 61.0 s, each further one -, peak memory 1.00 GB" in text
    assert "memory by stage fit 1.0 MB" in text
    assert "GPU X, 2 cores" in text
    assert "this evaluation peak memory 1.0 MB" in text


def test_the_quality_in_a_line() -> None:
    assert quality_text(report()) == "30.00 dB (30.50 after frame 0's colour fit)"
    assert quality_text(replace(report(), mean=scores())) == "30.00 dB"


def test_other_sizes_and_ghosts_have_a_table_of_what_is_known() -> None:
    known = scores(psnr_half=33.333, ssim_half=0.95, disoccluded_share=0.021, ghost_share=0.155, psnr_disoccluded=24.0)
    cameras = {"cam[0]": known, "side": replace(known, ghost_share=None)}
    text = shown(replace(report(cameras={"cam[0]": "held out", "side": "held out"}), cameras=cameras, mean=known))
    words = " ".join(text.split())
    assert "camera half SSIM disoccluded % ghosts % dB there" in words
    assert "cam[0] 33.33 0.9500 2.10 15.50 24.00" in words
    assert "side 33.33 0.9500 2.10 - 24.00" in words
    assert "stored" not in text


def test_the_worst_frames_are_named() -> None:
    changed = {"frame": 3, "camera": "cam[0]", "psnr_changed": 19.876}
    ghosts = {"frame": 2, "camera": "side", "ghost_share": 0.4, "disoccluded_share": 0.02}
    text = shown(report(worst={"changed": changed, "ghosts": ghosts}))
    assert "3 of cam[0]: 19.88 dB on changed pixels" in text
    assert "frame 2 of side: 40.0 % of the disoccluded pixels, 0.80 % of all" in text
