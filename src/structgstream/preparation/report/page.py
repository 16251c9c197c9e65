# SPDX-License-Identifier: Apache-2.0
"""The page of a report: what is wrong first, then every number and picture. It loads nothing from elsewhere."""

from collections.abc import Mapping, Sequence
from html import escape
from urllib.parse import quote

from structgstream.preparation.checking.findings import CameraCheck, CheckReport

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
        sections: heading to file names of pictures beside the page.
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
            f"<tr><td>{escape(step)}<td class=text>{escape(str(told))}" for step, told in report.steps.items()
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
