# SPDX-License-Identifier: Apache-2.0
"""Live runs from files that are read as cameras; cameras and queues on a terminal, and in lines."""

import json
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.cli.live_run import Dashboard, live_display
from structgstream.codec.reader import open_stream
from structgstream.data.live.source import LiveSource
from structgstream.data.live.status import CameraStatus, LiveStatus
from structgstream.data.open import open_capture
from structgstream.frames import MultiViewFrame
from structgstream.recorder import RunMetrics
from structgstream.training.result import Step
from tests.data.live.test_live_source import files
from tests.support.consoles import console, text
from tests.support.quick_streams import QUICK, Runner
from tests.support.reports import frame_report


@pytest.fixture
def live(tmp_path: Path, quick_tiny: None) -> list[str]:
    """The command, of a rig of three cameras."""
    return ["reconstruct", str(files(tmp_path, frames=60)), "-o", str(tmp_path / "x.sgs"), "--live", *QUICK]


def test_a_live_run_is_a_stream_a_log_metrics_and_a_recording(live: list[str], tmp_path: Path, run: Runner) -> None:
    out = run([*live, "--frames", "2", "--record", str(tmp_path / "take")]).out
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
    ("options", "status", "said"),
    [
        (["--start", "3"], 2, "--start chooses from a recording"),
        (["--every", "2"], 2, "--every chooses from a recording"),
        (["--frames", "0"], 2, "--frames must be at least 1"),
        (["--held-out", "zz"], 1, "zz"),
    ],
)
def test_options_that_live_cameras_do_not_have(
    live: list[str], options: list[str], status: int, said: str, run: Runner
) -> None:
    assert said in run([*live, *options], status=status).err


def test_options_of_live_cameras_need_the_word(live: list[str], tmp_path: Path, run: Runner) -> None:
    for options in (["--record", str(tmp_path / "take")], []):
        command = [word for word in live if word != "--live"]
        assert "give --live" in run([*command, *options], status=2).err


def test_ctrl_c_before_the_first_frame_leaves_no_stream(
    live: list[str], tmp_path: Path, run: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pressed(source: LiveSource, start: int = 0) -> Iterator[MultiViewFrame]:
        os.kill(os.getpid(), signal.SIGINT)
        yield from whole(source, start)

    whole = LiveSource.frames
    monkeypatch.setattr(LiveSource, "frames", pressed)
    said = run(live, status=130)
    assert "No frame was done, so no stream was written" in said.err
    assert "Wrote" not in said.out
    assert not (tmp_path / "x.sgs").exists()
    assert json.loads((tmp_path / "x.metrics.json").read_text())["state"] == "finished"


STATUS = LiveStatus(
    {"cam00": CameraStatus(True, 1234, 2), "cam01": CameraStatus(False, 7, 0, {"stuck": 3, "gone": 1})},
    sets=900,
    skipped_sets=880,
    delay_seconds=0.25,
)
REPORT = frame_report(4, bytes=2000, train_psnr=31.2, anchors=10, moving=10, free=0, seconds={"fit": 2.0, "total": 3.0})


def metrics(folder: Path) -> RunMetrics:
    made = RunMetrics(folder / "x.sgs", fps=30.0, live=lambda: STATUS)
    made.frame(REPORT)
    return made


def test_a_line_has_cameras_and_skipped_sets(tmp_path: Path) -> None:
    out = console(terminal=False)
    with live_display(metrics(tmp_path).values, console=out) as shown:
        shown.step(Step(1, 100, 0.5, 10, 0))
        shown.frame(REPORT)
    (line,) = text(out).splitlines()
    assert line.startswith("frame 5  train 31.20 dB")
    assert "1/2 cameras" in line
    assert "skipped 880  pictures 0.25 s old" in line


def test_the_dashboard_names_each_camera_with_its_faults(tmp_path: Path) -> None:
    out = console(terminal=True)
    with live_display(metrics(tmp_path).values, console=out) as shown:
        shown.step(Step(7, 100, 0.5, 10, 0))
        shown.frame(REPORT)
        shown.step(Step(8, 100, 0.5, 10, 0))
    drawn = text(out)
    for part in (
        "x.sgs  running",
        "cam00",
        "sends",
        "1,234",
        "absent",
        "stuck 3  gone 1",
        "iteration 8/100",
        "frame 5",
    ):
        assert part in drawn
    assert "fit 2.00 s" in drawn


def test_between_iterations_the_dashboard_tells_what_is_done(tmp_path: Path) -> None:
    def lines(shown: Dashboard) -> str:
        out = console(terminal=True)
        out.print(shown._drawn())
        return text(out)

    values = metrics(tmp_path).values
    shown = live_display(values, done=3, console=console(terminal=True))
    assert isinstance(shown, Dashboard)
    assert "frame 4  takes pictures" in lines(shown)
    shown.step(Step(7, 100, 0.5, 10, 0))
    assert "frame 4  iteration 7/100" in lines(shown)
    shown.frame(REPORT)
    assert "frame 6  takes pictures" in lines(shown)
    absent = replace(STATUS, cameras={"cam00": CameraStatus(False)})
    alone = RunMetrics(tmp_path / "y.sgs", fps=30.0, live=lambda: absent)
    assert "waits for cameras" in lines(Dashboard(alone.values, console=console(terminal=True)))


def test_on_a_narrow_terminal_no_value_is_broken(tmp_path: Path) -> None:
    out = console(terminal=True, width=48, height=40)
    with live_display(metrics(tmp_path).values, console=out) as shown:
        shown.frame(REPORT)
    lines = text(out).splitlines()
    for part in ("skipped 880", "pictures 0.25 s old", "train 31.20 dB", "10 anchors", "stuck 3"):
        assert any(part in line for line in lines), part


def test_each_quality_has_a_row(tmp_path: Path) -> None:
    made = RunMetrics(tmp_path / "x", fps=30.0, live=lambda: STATUS, qualities=("low", "high"))
    made.quality("low", REPORT)
    out = console(terminal=True)
    with live_display(made.values, console=out) as shown:
        shown.frame(REPORT, quality="low")
    last = text(out).splitlines()[-30:]
    (row,) = (line for line in last if line.strip("│ ").startswith("low "))
    assert row.strip("│ ").split() == ["low", "5", "480.0", "2.0", "kB", "31.20", "3.00"]
    (row,) = (line for line in last if line.strip("│ ").startswith("high "))
    assert row.strip("│ ").split() == ["high", "-", "-", "0", "B", "-", "-"]
    assert any("frame 5  low  train 31.20 dB" in line for line in last)
    lines = console(terminal=False)
    with live_display(made.values, console=lines) as shown:
        shown.frame(REPORT, quality="low")
    assert text(lines).startswith("frame 5  low  train 31.20 dB")
