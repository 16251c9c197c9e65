# SPDX-License-Identifier: Apache-2.0
"""Checks the capture in a folder, of any layout, and writes its report."""

from pathlib import Path

from structgstream.data.open import open_capture
from structgstream.data.prepared import read_prepared, recognizes_prepared
from structgstream.preparation.checking.check import Checked, check_capture
from structgstream.preparation.report.write import write_report
from structgstream.preparation.steps import Listener, Silent


def check_folder(path: Path, *, report: Path | None, listener: Listener | None = None) -> Checked:
    """The check of a capture.

    Args:
        path: its folder.
        report: folder for the report; None writes none.
        listener: is told of the progress.

    Raises:
        CaptureError: the capture cannot be opened or read.
        MissingExtraError: a package is missing that the check or the report needs.
        StorageError: the report cannot be written.
    """
    listener = listener or Silent()
    listener.begin("check", skipped=False)
    unit = read_prepared(path).unit if recognizes_prepared(path) else None
    checked = check_capture(open_capture(path), unit=unit, listener=listener)
    if report is not None:
        write_report(report, checked, listener=listener)
    listener.end("check", f"{len(checked.report.findings)} findings")
    return checked
