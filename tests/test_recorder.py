# SPDX-License-Identifier: Apache-2.0
"""The log is written with the stream: begun after what stays, a line before each report, closed with the session."""

from collections.abc import Generator
from pathlib import Path

import pytest

from structgstream.errors import StorageError
from structgstream.evaluation.run_log import append_log, log_path, read_log
from structgstream.recorder import check_output, log_reports
from structgstream.session.frame_report import FrameReport
from tests.support.reports import frame_report


def run(closed: list[str], start: int = 0) -> Generator[FrameReport, None, None]:
    try:
        for index in range(start, 3):
            yield frame_report(index)
    finally:
        closed.append("session")


def test_a_line_is_there_when_its_frame_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "x.sgs"
    reports = log_reports(run([]), path, done=0, remarks=lambda one: {"first": True} if one.index == 0 else {})
    for count, one in enumerate(reports, start=1):
        assert [*read_log(path)] == [*range(count)]
        assert one.index == count - 1
    assert ["first" in entry for entry in read_log(path).values()] == [True, False, False]


def test_a_resumed_log_keeps_what_is_stored_and_drops_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "x.sgs"
    for index in range(3):
        append_log(path, {"index": index, "run": 1})
    assert [one.index for one in log_reports(run([], start=2), path, done=2)] == [2]
    assert [entry.get("run") for entry in read_log(path).values()] == [1, 1, None]


def test_closing_it_closes_the_session(tmp_path: Path) -> None:
    closed: list[str] = []
    reports = log_reports(run(closed), tmp_path / "x.sgs", done=0)
    next(reports)
    assert not closed
    reports.close()
    assert closed == ["session"]


def test_a_log_that_cannot_be_written_ends_the_session(tmp_path: Path) -> None:
    closed: list[str] = []
    reports = log_reports(run(closed), tmp_path / "x.sgs", done=0)
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
