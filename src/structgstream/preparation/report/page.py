# SPDX-License-Identifier: Apache-2.0
"""The report of a check in a folder: ``index.html``, its pictures and ``report.json``.

The page states what is wrong first, then every number and picture. It loads nothing from elsewhere.
"""

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from structgstream.atomic_files import atomic_write
from structgstream.errors import StorageError
from structgstream.preparation.checking.check import Checked
from structgstream.preparation.checking.findings import CameraCheck, CheckReport
from structgstream.preparation.report.pictures import (
    chosen_pairs,
    draw_colors,
    draw_coverage,
    draw_epipolar,
    draw_matrix,
    draw_overlay,
    draw_times,
)
from structgstream.preparation.steps import Listener, Silent

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; max-width: 68rem; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin: 0 0 .3rem; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p.sub { color: #666; margin: 0 0 1rem; }
ul.findings { list-style: none; padding: 0; }
ul.findings li { border-left: 4px solid; padding: .5rem .8rem; margin: .5rem 0; background: #fafafa; }
li.error { border-color: #d55e00; } li.warning { border-color: #e69f00; } li.note { border-color: #0072b2; }
li.fine { border-color: #009e73; }
table { border-collapse: collapse; font-size: .86rem; }
th, td { text-align: right; padding: .25rem .7rem; border-bottom: 1px solid #e4e4e4; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } th { color: #666; font-weight: 600; }
tr.off td { color: #d55e00; font-weight: 600; }
div.wide { overflow-x: auto; }
img { max-width: 100%; height: auto; display: block; margin: .6rem 0; }
div.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(26rem, 1fr)); gap: .4rem 1rem; }
td.text { text-align: left; white-space: normal; }
"""


def page(report: CheckReport, *, off: Sequence[str], sections: Mapping[str, Sequence[str]]) -> str:
    """The page's HTML.

    Args:
        report: the numbers.
        off: cameras to mark.
        sections: heading to file names of pictures in the folder.
    """
    parts = [
        f"<!doctype html>\n<html lang=en><meta charset=utf-8><title>{escape(report.capture)}: check</title>",
        "<meta name=viewport content='width=device-width'>",
        f"<style>{STYLE}</style><h1>{escape(report.capture)}</h1>",
        f"<p class=sub>{escape(_facts(report))}</p>",
        _findings(report),
    ]
    if report.steps:
        rows = "".join(
            f"<tr><td>{escape(step)}<td class=text>{escape(str(summary))}" for step, summary in report.steps.items()
        )
        parts.append(f"<h2>Preparation</h2><table>{rows}</table>")
    parts.append(f"<h2>Cameras</h2><div class=wide>{_table(report, off)}</div>")
    for heading, pictures in sections.items():
        if pictures:
            images = "".join(f"<img src='{quote(name)}' alt='{escape(name)}' loading=lazy>" for name in pictures)
            grid = " class=grid" if len(pictures) > 2 and heading.startswith("What") else ""
            parts.append(f"<h2>{escape(heading)}</h2><div{grid}>{images}</div>")
    parts.append("<p class=sub>Every number: <a href='report.json'>report.json</a></p></html>\n")
    return "\n".join(parts)


def _facts(report: CheckReport) -> str:
    radius = f"{report.rig_radius:.3g}"
    unit = ("metre" if report.unit == "metres" else "unit") + "s" * (radius != "1")
    unit += "" if report.unit == "metres" else " of the capture"
    nearest = "" if report.nearest is None else f", nearest points at {report.nearest:.3g}"
    coverage = report.coverage
    matched = sum(pair.matches > 0 for pair in report.pairs)
    median = report.median_epipolar_pixels
    error = "no pair has matches" if median is None else f"median error of {matched} pairs {median:.2f} pixels"
    return (
        f"{len(report.cameras)} cameras within {radius} {unit} of their middle; {error}; near plane at "
        f"{report.near:.3g}{nearest}; {coverage.points} points, {coverage.seen_by_three:.0%} of them seen by three "
        "cameras or more."
    )


def _findings(report: CheckReport) -> str:
    if not report.findings:
        return "<ul class=findings><li class=fine>Nothing is wrong.</li></ul>"
    items = "".join(f"<li class={found.severity}>{escape(found.sentence)}</li>" for found in report.findings)
    return f"<ul class=findings>{items}</ul>"


COLUMNS = (
    ("error, px", "reprojection_pixels", "{:.2f}"),
    ("90 %, px", "reprojection_pixels_90", "{:.2f}"),
    ("points", "points", "{}"),
    ("overlaps", "overlaps", "{}"),
    ("exposure, stops", "exposure_stops", "{:+.2f}"),
    ("red, stops", "red_stops", "{:+.2f}"),
    ("blue, stops", "blue_stops", "{:+.2f}"),
    ("late by, ms", "offset_ms", "{:+.1f}"),
    ("frames lacking", "frames_lacking", "{}"),
)


def _table(report: CheckReport, off: Sequence[str]) -> str:
    head = "".join(f"<th>{title}" for title, _, _ in COLUMNS)
    rows = "".join(
        f"<tr{' class=off' if name in off else ''}><td>{escape(name)}{_cells(camera)}"
        for name, camera in report.cameras.items()
    )
    return f"<table><tr><th>camera{head}{rows}</table>"


def _cells(camera: CameraCheck) -> str:
    values = ((getattr(camera, key), text) for _, key, text in COLUMNS)
    return "".join(f"<td>{'-' if value is None else text.format(value)}" for value, text in values)


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
