# SPDX-License-Identifier: Apache-2.0
"""The command ``evaluate``."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from structgstream.cli import evaluate, main
from structgstream.codec.reader import open_stream
from structgstream.data.source import SourceWrapper
from structgstream.evaluation.recording import capture_of
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import select_backend
from tests.support.backends import QUICKEST
from tests.support.quick_streams import CLIP, error_of


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
    table = capsys.readouterr().out
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
    stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STRUCTGSTREAM_LPIPS_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    arguments = ["evaluate", str(stream), CLIP, "--device", QUICKEST]
    assert main(arguments) == 0
    table = " ".join(capsys.readouterr().out.split())
    assert "lpips_alex, t_lpips: the weights of AlexNet were not found" in table
    assert "ms_ssim: pictures need 161 pixels a side" in table
    assert "tFLIP" in table
    assert main([*arguments, "--metrics", "basic"]) == 0
    table = capsys.readouterr().out
    assert "tFLIP" not in table
    assert "not available" not in table
    nowhere = [*arguments, "--lpips-weights", str(tmp_path / "none")]
    assert "none, where the path given has the weights" in error_of(nowhere, capsys, status=1)
