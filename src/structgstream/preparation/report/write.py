# SPDX-License-Identifier: Apache-2.0
"""Writes the report of a check into a folder: ``index.html``, pictures and ``report.json``."""

import json
import re
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.errors import StorageError
from structgstream.preparation.checking.check import Checked
from structgstream.preparation.report.charts import draw_colors, draw_coverage, draw_matrix, draw_times
from structgstream.preparation.report.overlays import chosen_pairs, draw_epipolar, draw_overlay
from structgstream.preparation.report.page import page
from structgstream.preparation.steps import Listener, Silent

PAGE, NUMBERS = "index.html", "report.json"


def write_report(folder: Path, checked: Checked, *, listener: Listener | None = None) -> Path:
    """The report in ``folder``, in place of an earlier one; returns the page.

    Raises:
        MissingExtraError: matplotlib is not installed.
        StorageError: a file cannot be written.
    """
    report, examined = checked.report, checked.examination
    _empty(folder)
    listener = listener or Silent()
    pairs = chosen_pairs(examined)
    total = len(examined.cameras) + len(pairs)
    overlays, lines = [], []
    for number, name in enumerate(examined.cameras):
        listener.progress(number, total, f"picture of {name}")
        overlays.append(f"camera_{_file_name(name)}.png")
        draw_overlay(folder / overlays[-1], examined, report, name)
    for number, pair in enumerate(pairs):
        listener.progress(len(examined.cameras) + number, total, "epipolar lines")
        lines.append(f"lines_{number}.png")
        draw_epipolar(folder / lines[-1], examined, pair)
    suspects = examined.suspects
    draw_matrix(folder / "pairs.png", report, limit_pixels=suspects.limit_pixels, stray=suspects.stray)
    draw_coverage(folder / "coverage.png", examined, near=report.near, unit=report.unit or "")
    charts = []
    if any(camera.offset_ms is not None for camera in report.cameras.values()):
        draw_times(folder / "times.png", report)
        charts.append("times.png")
    if any(camera.exposure_stops is not None for camera in report.cameras.values()):
        draw_colors(folder / "colors.png", report)
        charts.append("colors.png")
    sections = {
        "What each camera sees, and where the points of the others fall": overlays,
        "Error of pairs": ["pairs.png"],
        "Epipolar lines of some pairs": lines,
        "Rig and coverage": ["coverage.png"],
        "Times and colours" if len(charts) == 2 else "Times" if "times.png" in charts else "Colours": charts,
    }
    atomic_write(folder / NUMBERS, f"{json.dumps(report.as_json(), indent=1)}\n".encode())
    atomic_write(folder / PAGE, page(report, off=examined.suspects.off, sections=sections).encode())
    listener.progress(total, total, "")
    return folder / PAGE


def _empty(folder: Path) -> None:
    """Removes an earlier report, and nothing else."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for pattern in ("camera_*.png", "lines_*.png", "times.png", "colors.png"):
            for file in folder.glob(pattern):
                file.unlink()
    except OSError as error:
        raise StorageError(f"The report in {folder} cannot be written ({error.strerror}); choose another.") from None


def _file_name(name: str) -> str:
    """A camera's name as part of a file's."""
    return re.sub(r"[^0-9A-Za-z._-]", "_", name)
