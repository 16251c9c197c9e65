# SPDX-License-Identifier: Apache-2.0
"""The log is written with the stream: begun after what stays, a line before each report, closed with the session."""

import json
import threading
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.cli.app import Terminated
from structgstream.data.live.status import CameraStatus, LiveStatus
from structgstream.errors import StorageError
from structgstream.evaluation.run_log import log_path, read_log
from structgstream.recorder import RunMetrics, check_output, free_bytes, logged, metrics_path
from structgstream.session.frame_report import FrameReport
from tests.support.reports import frame_report


def run(closed: list[str]) -> Generator[FrameReport, None, None]:
    try:
        for index in range(3):
            yield frame_report(index)
    finally:
        closed.append("session")


def test_a_line_is_there_when_its_frame_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "x.sgs"
    reports = logged(run([]), path, remarks=lambda one: {"first": True} if one.index == 0 else {})
    for count, one in enumerate(reports, start=1):
        assert [*read_log(path)] == [*range(count)]
        assert one.index == count - 1
    assert ["first" in entry for entry in read_log(path).values()] == [True, False, False]


def test_closing_it_closes_the_session(tmp_path: Path) -> None:
    closed: list[str] = []
    reports = logged(run(closed), tmp_path / "x.sgs")
    next(reports)
    assert not closed
    reports.close()
    assert closed == ["session"]


def test_a_log_that_cannot_be_written_ends_the_session(tmp_path: Path) -> None:
    closed: list[str] = []
    reports = logged(run(closed), tmp_path / "x.sgs")
    next(reports)
    log_path(tmp_path / "x.sgs").unlink()
    log_path(tmp_path / "x.sgs").mkdir()
    with pytest.raises(StorageError):
        next(reports)
    assert closed == ["session"]


def test_where_a_stream_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "there.sgs").write_bytes(b"x")
    check_output(tmp_path / "there.sgs", may_exist=True)
    check_output(tmp_path / "new" / "x.sgs", may_exist=False)
    with pytest.raises(StorageError, match="exists"):
        check_output(tmp_path / "there.sgs", may_exist=False)
    with pytest.raises(StorageError, match="is a folder"):
        check_output(tmp_path, may_exist=True)
    with pytest.raises(StorageError, match="cannot be created"):
        check_output(tmp_path / "there.sgs" / "x" / "y.sgs", may_exist=False)


CAMERAS = {"a": CameraStatus(True, 40, 1, {"jump": 1}), "b": CameraStatus()}


class Clock:
    """Seconds that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def read(stream: Path) -> dict:
    return json.loads(metrics_path(stream).read_text(), parse_constant=lambda name: pytest.fail(name))


def test_rates_stages_and_sizes_are_of_the_last_frames(tmp_path: Path) -> None:
    clock, sets, stream = Clock(), [0], tmp_path / "x.sgs"
    metrics = RunMetrics(
        stream,
        fps=10.0,
        live=lambda: LiveStatus(CAMERAS, sets[0], skipped_sets=5),
        captured=lambda index: 1.7e9 - index,
        now=clock,
        unix=lambda: 1.7e9,
    )
    extras = {}
    for index in range(5):
        clock.now += 2.0
        sets[0] += 20
        report = frame_report(index, bytes=1000, train_psnr=30.0, seconds={"fit": 1.5, "total": 2.0})
        extras = metrics.frame(replace(report, pts_seconds=0.5 * index, absent=("b",)))
    values = read(stream)
    assert (values["format"], values["version"], values["state"]) == ("structgstream-metrics", 1, "running")
    assert (values["frames"], values["frames_total"], values["bytes"]) == (5, None, 5000)
    assert values["frames_out_per_second"] == pytest.approx(0.5)
    assert values["frames_in_per_second"] == pytest.approx(10.0)
    assert values["bits_per_second"] == pytest.approx(8 * 5000 / 2.1)
    assert values["seconds_by_stage"] == {"fit": 1.5, "total": 2.0}
    assert (values["train_psnr"], values["absent"], values["pts_seconds"]) == (30.0, ["b"], 2.0)
    assert values["live"]["cameras"]["a"] == {"present": True, "decoded": 40, "queued": 1, "faults": {"jump": 1}}
    assert values["disk_free_bytes"] > 0
    assert values["stored_after_seconds"] == extras["run"]["stored_after_seconds"] == 4.0
    assert extras["run"]["live"]["skipped_sets"] == 5
    assert not list(tmp_path.glob("*.partial"))


def test_each_quality_has_its_own_numbers(tmp_path: Path) -> None:
    metrics = RunMetrics(tmp_path / "x", fps=10.0, qualities=("low", "high"))
    metrics.quality("low", frame_report(0, bytes=100, train_psnr=25.0, anchors=7, seconds={"total": 1.0}))
    values = metrics.values()
    assert values["qualities"]["low"] == {
        "frames": 1,
        "pts_seconds": 0.0,
        "bytes": 100,
        "bits_per_second": pytest.approx(8000.0),
        "seconds_by_stage": {"total": 1.0},
        "train_psnr": 25.0,
        "anchors": 7,
        "free": 0,
    }
    assert values["qualities"]["high"]["bytes"] == 0
    assert values["qualities"]["high"]["frames"] is values["qualities"]["high"]["train_psnr"] is None
    metrics.quality("high", frame_report(0, bytes=300, train_psnr=30.0, seconds={"total": 2.0}))
    metrics.frame(frame_report(0, bytes=400, seconds={"total": 3.0}))
    values = read(tmp_path / "x")
    assert (values["frames"], values["bytes"], values["seconds_by_stage"]) == (1, 400, {"total": 3.0})
    assert values["train_psnr"] is values["anchors"] is values["free"] is None
    assert values["qualities"]["high"]["train_psnr"] == 30.0
    assert "qualities" not in RunMetrics(tmp_path / "y", fps=10.0).values()


def test_before_the_first_frame_and_of_a_recording_what_is_unknown_is_null(tmp_path: Path) -> None:
    metrics = RunMetrics(tmp_path / "x.sgs", fps=30.0, total=12)
    metrics.write()
    values = read(tmp_path / "x.sgs")
    assert (values["state"], values["frames_total"], values["live"]) == ("waiting", 12, None)
    assert values["train_psnr"] is values["bits_per_second"] is values["frames_out_per_second"] is None
    report = frame_report(0, train_psnr=float("nan"), seconds={"total": 1.0})
    assert metrics.frame(report) == {}
    assert read(tmp_path / "x.sgs")["train_psnr"] is None


@pytest.mark.parametrize(
    ("error", "state"),
    [(None, "finished"), (KeyboardInterrupt, "finished"), (Terminated, "finished"), (OSError, "failed")],
)
def test_how_a_run_ended_is_the_last_word(tmp_path: Path, error: type[BaseException] | None, state: str) -> None:
    metrics = RunMetrics(tmp_path / "x.sgs", fps=30.0)

    def run() -> None:
        with metrics.running():
            if error is not None:
                raise error

    if error is None:
        run()
    else:
        with pytest.raises(error):
            run()
    assert read(tmp_path / "x.sgs")["state"] == state


def test_a_disk_that_is_full_does_not_end_the_run(tmp_path: Path) -> None:
    (tmp_path / "x.metrics.json.partial").mkdir()
    RunMetrics(tmp_path / "x.sgs", fps=30.0).write()
    assert free_bytes(tmp_path / "not" / "yet" / "there") == pytest.approx(free_bytes(tmp_path), rel=0.2)


def test_threads_that_write_at_a_time_leave_one_whole_file(tmp_path: Path) -> None:
    """The one that beats, and the one that has made a frame."""
    metrics = RunMetrics(tmp_path / "x.sgs", fps=30.0)
    metrics.write()

    def write() -> None:
        for _ in range(100):
            metrics.write()

    threads = [threading.Thread(target=write) for _ in range(2)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        assert read(tmp_path / "x.sgs")["state"] == "waiting"
    assert [path.name for path in tmp_path.iterdir()] == ["x.metrics.json"]
