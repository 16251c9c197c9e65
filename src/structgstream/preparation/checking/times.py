# SPDX-License-Identifier: Apache-2.0
"""Whether pictures of one frame are of one moment, from what moves in them."""

from structgstream.data.source import FrameSource
from structgstream.pose_check.findings import Finding
from structgstream.preparation.synchronization import SynchronizationCheck, check_synchronization

FRAMES = 90
MIN_FRAMES = 8
WARNED_SECONDS = 5e-3
SIGMAS, SURE_SIGMAS = 3.0, 2.0


def measure_times(source: FrameSource) -> SynchronizationCheck | None:
    """By how much each camera is late; None for a capture too short to tell.

    Raises:
        CaptureError: the pictures cannot be read.
        MissingExtraError: cv2 or scipy is not installed.
    """
    return check_synchronization(source, frames=FRAMES) if len(source) >= MIN_FRAMES else None


def time_findings(measured: SynchronizationCheck | None) -> list[Finding]:
    """An error for cameras that are off by a good part of a frame, a warning above 5 ms; a note if none can be told.

    Cameras are off whose pictures show another instant than their time stamps say. Pictures that by their stamps lie
    between those of the others are warned of once.
    """
    if measured is None:
        return []
    findings = []
    if measured.between:
        findings.append(Finding("warning", measured.between_message, tuple(measured.between)))
    if not measured.conclusive:
        return [*findings, Finding("note", measured.message)]
    for name, late in measured.late_seconds.items():
        if abs(late) < max(WARNED_SECONDS, SIGMAS * measured.uncertainty_seconds[name]):
            continue
        amount = f"{1e3 * abs(late):.1f} ms ({abs(late) / measured.period_seconds:.2f} frames)"
        which = "late" if late > 0 else "early"
        # What is surely more than half a frame another choice of frames mends.
        surely = abs(late) - SURE_SIGMAS * measured.uncertainty_seconds[name]
        if abs(late) > 0.6 * measured.period_seconds and surely > 0.5 * measured.period_seconds:
            sentence = f"Camera {name!r} is {amount} {which}; synchronise again, or correct its clock in capture.json."
            findings.append(Finding("error", sentence, (name,)))
        elif name in measured.off:
            sentence = (
                f"Camera {name!r} is {amount} {which}: less than a frame, which choosing frames cannot mend; what "
                "moves fast will blur there. Cameras that one signal starts have no such rest."
            )
            findings.append(Finding("warning", sentence, (name,)))
    return findings
