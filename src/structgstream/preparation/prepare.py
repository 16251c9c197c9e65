# SPDX-License-Identifier: Apache-2.0
"""From videos of still cameras to a calibrated capture, step by step; steps that were done are not done again.

:func:`check_folder` is the last step for a capture of any layout.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from structgstream.data.calibration import Calibration
from structgstream.data.camera_files import REPORT
from structgstream.data.open import open_capture
from structgstream.data.prepared import read_prepared, recognizes_prepared
from structgstream.pose_check.findings import Finding
from structgstream.preparation.camera_steps import CameraSteps, check_used, chosen_method
from structgstream.preparation.capture_steps import CaptureSteps, assembled
from structgstream.preparation.checking.check import Checked, check_capture
from structgstream.preparation.footage import Footage
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.output_folder import lock_output
from structgstream.preparation.report import write_report
from structgstream.preparation.steps import Job, Listener, Silent, Steps


@dataclass(frozen=True)
class Preparation:
    """A capture that was prepared.

    Args:
        path: its folder, for ``open_capture`` and ``reconstruct``.
        findings: of the check, errors first.
        steps: summaries of the steps.
        skipped: steps whose results were there already.
        report: the page of the report.
    """

    path: Path
    findings: tuple[Finding, ...]
    steps: Mapping[str, str]
    skipped: tuple[str, ...]
    report: Path


def prepare_capture(
    videos: Path, capture: Path, *, options: PrepareOptions | None = None, listener: Listener | None = None
) -> Preparation:
    """Makes the capture, or goes on with one that was interrupted.

    Args:
        videos: the folder of the cameras' videos or pictures, see ``preparation.footage``.
        capture: the folder to make; the same call again does only what has changed.
        options: of the preparation.
        listener: receives steps and progress.

    Raises:
        CaptureError: the videos cannot be read, synchronised or calibrated, or ``capture`` holds something else.
        ConfigError: options that the cameras do not allow.
        StorageError: the capture cannot be written.
    """
    options = options or PrepareOptions()
    job = Job(videos, capture, options, Steps(capture, listener or Silent()))
    find = CameraSteps(job)
    footage = find.find()
    method = chosen_method(footage, options)
    check_used(method, footage, options)
    if method == "board":
        options.board.opencv_board()  # raises, before anything takes time, for markers that OpenCV does not have
    with lock_output(capture):
        return _made(job, find, footage, method)


def _made(job: Job, find: CameraSteps, footage: Footage, method: str | Calibration) -> Preparation:
    """The steps from the clocks on."""
    options = job.options
    first = find.synchronize(footage, method)
    solved = find.calibrate(footage, first, method)
    clocks = find.synchronize_again(footage, first, method, solved)
    content = assembled(footage, clocks.clocks, solved, options)
    make = CaptureSteps(job)
    make.link(footage, content)
    content = make.points(make.near(content))
    findings = make.check(content)
    return Preparation(
        job.capture, findings, job.steps.summaries, tuple(job.steps.skipped), job.capture / REPORT / "index.html"
    )


def check_folder(path: Path, *, report: Path | None, listener: Listener | None = None) -> Checked:
    """The check of a capture.

    Args:
        path: its folder.
        report: folder for the report; None writes none.
        listener: receives the progress.

    Raises:
        CaptureError: the capture cannot be opened or read.
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
