# SPDX-License-Identifier: Apache-2.0
"""The check of a folder, and its report."""

from pathlib import Path

import pytest

from structgstream.errors import CaptureError, StorageError
from structgstream.preparation.prepare import check_folder
from tests.support.quick_preparation import Heard
from tests.support.rooms import write_room


def test_a_folder_of_any_layout_is_checked_and_reported(tmp_path: Path) -> None:
    write_room(tmp_path / "room")
    heard = Heard()
    checked = check_folder(tmp_path / "room", report=tmp_path / "report", listener=heard)
    assert (tmp_path / "report" / "index.html").is_file()
    assert heard.calls[0] == ("begin", "check", False)
    assert heard.calls[-1] == ("end", "check", f"{len(checked.report.findings)} findings")
    before = sorted(tmp_path.rglob("*"))
    again = check_folder(tmp_path / "room", report=None)
    assert again.report.findings == checked.report.findings
    assert sorted(tmp_path.rglob("*")) == before


def test_a_report_that_cannot_be_written_is_noticed_first(tmp_path: Path) -> None:
    write_room(tmp_path / "room")
    (tmp_path / "file").write_text("")
    heard = Heard()
    with pytest.raises(StorageError, match="report of a check"):
        check_folder(tmp_path / "room", report=tmp_path / "file" / "report", listener=heard)
    assert heard.calls == [("begin", "check", False)]


def test_what_is_no_capture(tmp_path: Path) -> None:
    with pytest.raises(CaptureError):
        check_folder(tmp_path, report=tmp_path / "report")
    assert not (tmp_path / "report").exists()
