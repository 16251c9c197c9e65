# SPDX-License-Identifier: Apache-2.0
"""``reconstruct --live`` from files that are read as cameras."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.cli.app import INTERRUPTED, PROBLEM, USAGE, main
from structgstream.codec.reader import open_stream
from structgstream.data.live.source import LiveSource
from structgstream.data.open import open_capture
from structgstream.frames import MultiViewFrame
from tests.data.live.test_live_source import files
from tests.support.small_presets import few_points

QUICKLY = ["--preset", "tiny", "--initial.iterations", "3", "--online.iterations", "2", "--device", "cpu"]


def live(folder: Path, *options: str, rig: Path | None = None) -> int:
    scene = files(folder, frames=60) if rig is None else rig
    with few_points("tiny"):
        return main(["reconstruct", str(scene), "-o", str(folder / "x.sgs"), "--live", *QUICKLY, *options])


def test_a_live_run_is_a_stream_a_log_metrics_and_a_recording(tmp_path: Path, capsys) -> None:
    assert live(tmp_path, "--frames", "2", "--record", str(tmp_path / "take")) == 0
    out = capsys.readouterr().out
    assert "2 training cameras, held out: a; live; preset tiny" in out
    assert "/3 cameras  in " in out
    with open_stream(tmp_path / "x.sgs") as reader:
        assert reader.complete
        assert len(reader) == 2
        times = [info.pts_seconds for info in reader.packets]
        assert times[0] == 0.0 < times[1]
    metrics = json.loads((tmp_path / "x.metrics.json").read_text())
    assert (metrics["state"], metrics["frames"]) == ("finished", 2)
    last = json.loads((tmp_path / "x.log.jsonl").read_text().splitlines()[-1])
    assert set(last["run"]["live"]["cameras"]) == {"a", "b", "c"}
    assert len(open_capture(tmp_path / "take")) >= 3


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--start", "3"], "--start chooses from a recording"),
        (["--every", "2"], "--every chooses from a recording"),
        (["--frames", "0"], "--frames must be at least 1"),
        (["--held-out", "zz"], "zz"),
    ],
)
def test_options_that_live_cameras_do_not_have(tmp_path: Path, capsys, options: list[str], said: str) -> None:
    assert live(tmp_path, *options) in (USAGE, PROBLEM)
    assert said in capsys.readouterr().err


def test_options_of_live_cameras_need_the_word(tmp_path: Path, capsys) -> None:
    rig = files(tmp_path)
    for options in (["--record", str(tmp_path / "take")], []):
        assert main(["reconstruct", str(rig), "-o", str(tmp_path / "x.sgs"), *options]) == USAGE
        assert "give --live" in capsys.readouterr().err


def test_ctrl_c_before_the_first_frame_leaves_no_stream(tmp_path: Path, capsys, monkeypatch) -> None:
    def pressed(source: LiveSource, start: int = 0) -> Iterator[MultiViewFrame]:
        os.kill(os.getpid(), signal.SIGINT)
        yield from whole(source, start)

    whole = LiveSource.frames
    monkeypatch.setattr(LiveSource, "frames", pressed)
    assert live(tmp_path) == INTERRUPTED
    said = capsys.readouterr()
    assert "No frame was done, so no stream was written" in said.err
    assert "Wrote" not in said.out
    assert not (tmp_path / "x.sgs").exists()
    assert json.loads((tmp_path / "x.metrics.json").read_text())["state"] == "finished"
