# SPDX-License-Identifier: Apache-2.0
"""The check of a folder, and its report."""

from pathlib import Path

import pytest

from structgstream.errors import CaptureError, StorageError
from structgstream.preparation.prepare import check_folder
from tests.support.rooms import write_room


class Noted:
    """Notes the steps."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def begin(self, step: str, *, skipped: bool) -> None:
        self.calls.append(f"begin {step} {skipped}")

    def progress(self, done: int, total: int, what: str) -> None:
        self.calls.append("progress")

    def end(self, step: str, summary: str) -> None:
        self.calls.append(f"end {step}: {summary}")


def test_a_folder_of_any_layout_is_checked_and_reported(tmp_path: Path) -> None:
    write_room(tmp_path / "room")
    noted = Noted()
    checked = check_folder(tmp_path / "room", report=tmp_path / "report", listener=noted)
    assert (tmp_path / "report" / "index.html").is_file()
    assert noted.calls[0] == "begin check False"
    assert noted.calls[-1] == f"end check: {len(checked.report.findings)} findings"
    before = sorted(tmp_path.rglob("*"))
    again = check_folder(tmp_path / "room", report=None)
    assert again.report.findings == checked.report.findings
    assert sorted(tmp_path.rglob("*")) == before


def test_a_report_that_cannot_be_written_is_noticed_first(tmp_path: Path) -> None:
    write_room(tmp_path / "room")
    (tmp_path / "file").write_text("")
    noted = Noted()
    with pytest.raises(StorageError, match="report of a check"):
        check_folder(tmp_path / "room", report=tmp_path / "file" / "report", listener=noted)
    assert noted.calls == ["begin check False"]


def test_what_is_no_capture(tmp_path: Path) -> None:
    with pytest.raises(CaptureError):
        check_folder(tmp_path, report=tmp_path / "report")
    assert not (tmp_path / "report").exists()
