# SPDX-License-Identifier: Apache-2.0
"""The report of a check in a folder: ``index.html``, its pictures and ``report.json``.

The page states what is wrong first, then every number and picture. It loads nothing from elsewhere."""

import json
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from structgstream.atomic_files import atomic_write
from structgstream.data.matching import Pair, epipolar_errors, fundamental_matrix, level_normal
from structgstream.figure import COLORS, FAINT, INK, OTHER, figure_of, save_figure, without_frame
from structgstream.geometry import Floats
from structgstream.owned_folders import own_folder, remove_own
from structgstream.pose_check.tracks import pair_errors
from structgstream.preparation.checking.check import Checked, CheckReport, Examination
from structgstream.preparation.checking.overlap import cameras_per_point
from structgstream.preparation.output_folder import Listener, Silent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LIMIT_MS = 5.0
MAX_NUMBERED = 16  # cameras
FAR_PERCENTILE = 97.0
MAX_LABELS = 60
LABEL_REACH = 0.06  # of the rig's radius: closer cameras share a label


def draw_matrix(path: Path, report: CheckReport, *, limit_pixels: float, stray: Collection[Pair] = ()) -> None:
    """Median epipolar error of every pair; pairs without matches stay white, pairs ``stray`` have a cross."""
    names = list(report.cameras)
    values = np.full((len(names), len(names)), np.nan)
    for pair in report.pairs:
        if pair.epipolar_pixels is not None:
            one, other = names.index(pair.first), names.index(pair.second)
            values[one, other] = values[other, one] = pair.epipolar_pixels
    side = float(np.clip(0.42 * len(names) + 1.6, 4.5, 13))
    figure = figure_of(side + 0.8, side)
    axis = figure.subplots()
    shown = axis.imshow(values, cmap="viridis", vmin=0, vmax=2 * limit_pixels)
    axis.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.set_xticks(np.arange(len(names) + 1) - 0.5, minor=True)
    axis.set_yticks(np.arange(len(names) + 1) - 0.5, minor=True)
    axis.grid(which="minor", color=FAINT, linewidth=0.6)
    axis.tick_params(which="both", length=0)
    axis.spines[:].set_visible(False)
    crossed = {(names.index(one), names.index(other)) for pair in stray for one, other in (pair, pair[::-1])}
    for row, column in zip(*np.nonzero(np.isfinite(values))):
        label = [f"{values[row, column]:.1f}"] * (len(names) <= MAX_NUMBERED) + ["x"] * ((row, column) in crossed)
        if label:
            dark = values[row, column] < 1.3 * limit_pixels
            axis.text(
                column, row, " ".join(label), ha="center", va="center", fontsize=7, color="white" if dark else INK
            )
    _add_bar(figure, shown, "median distance to epipolar lines, pixels", ax=axis, shrink=0.7, pad=0.02, extend="max")
    crosses = "\nx: both cameras fit others, so most likely these are wrong matches" if crossed else ""
    axis.set_title(f"Error of each pair; white: no matches{crosses}", fontsize=10, loc="left", color=INK)
    save_figure(figure, path)


def draw_coverage(path: Path, examined: Examination, *, near: float, unit: str) -> None:
    """The rig and the points from above and from the side, coloured by the number of cameras that see them."""
    cameras = examined.cameras
    centers = np.stack([camera.center.numpy() for camera in cameras.values()])
    axes = np.stack([camera.viewmat.numpy()[2, :3] for camera in cameras.values()])
    points, counts = examined.tracks.points, cameras_per_point(examined.tracks.points, cameras)
    frame = _level_frame(examined, centers)
    centers, axes, points = centers @ frame.T, axes @ frame.T, points @ frame.T
    points, counts = _within(points, counts, centers)
    radius = max(float(np.linalg.norm(centers - centers.mean(0), axis=1).max()), 1e-9)
    figure = figure_of(11.0, 5.4)
    label = unit if unit == "metres" else "units of the capture"
    shown = None
    for axis, (across, up), title in zip(
        figure.subplots(1, 2), ((0, 1), (1, 2)), ("from above", "from the side"), strict=True
    ):
        if len(points):
            shown = axis.scatter(
                points[:, across], points[:, up], c=counts, cmap="viridis", s=5, vmin=0, vmax=len(cameras)
            )
        for number, name in enumerate(cameras):
            off = name in examined.suspects.off
            color = COLORS[3] if off else INK
            start = centers[number]
            axis.annotate(
                "", start[[across, up]] + 0.22 * radius * axes[number][[across, up]], start[[across, up]],
                arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.2, "shrinkA": 0, "shrinkB": 0},
            )  # fmt: skip
            axis.plot(start[across], start[up], "s", color=color, markersize=5)
        labels = [
            name for name in cameras if name in examined.suspects.off or (len(cameras) <= MAX_LABELS and across == 0)
        ]
        _draw_labels(axis, examined, labels, centers[:, [across, up]], axes[:, [across, up]], radius=radius)
        axis.set_aspect("equal", adjustable="datalim")
        axis.margins(0.08)
        axis.set_title(title, fontsize=10, loc="left", color=INK)
        axis.set_xlabel(label, fontsize=8)
        without_frame(axis)
        axis.grid(axis="both", color=FAINT, linewidth=0.8)
    if shown is not None:
        _add_bar(figure, shown, "cameras whose picture holds the point", ax=figure.axes, shrink=0.8, pad=0.01)
    figure.suptitle(f"Rig and points (near plane at {near:.3g} {label})", fontsize=10, color=INK)
    save_figure(figure, path)


def _add_bar(figure: "Figure", shown: Any, label: str, **options: Any) -> None:
    """A bar of the colours that are shown, with its label."""
    bar = figure.colorbar(shown, **options)
    bar.set_label(label, fontsize=8, color=INK)
    bar.ax.tick_params(labelsize=8)


def draw_colors(path: Path, report: CheckReport) -> None:
    """Exposure and white balance of each camera against the median camera."""
    names = [name for name, camera in report.cameras.items() if camera.exposure_stops is not None]
    figure, axis = _chart(names, "Exposure and white balance", "stops against the median camera")
    at = np.arange(len(names))
    kinds = (("exposure_stops", "exposure", OTHER), ("red_stops", "red / green", COLORS[3]),
             ("blue_stops", "blue / green", COLORS[0]))  # fmt: skip
    for number, (key, label, color) in enumerate(kinds):
        values = [getattr(report.cameras[name], key) for name in names]
        axis.bar(at + 0.27 * (number - 1), values, width=0.25, color=color, label=label)
    largest = max((abs(getattr(report.cameras[name], key)) for name in names for key, _, _ in kinds), default=0)
    axis.set_ylim(-max(0.4, 1.15 * largest), max(0.4, 1.15 * largest))
    axis.legend(fontsize=8, frameon=False, ncols=3, loc="upper right")
    save_figure(figure, path)


def draw_times(path: Path, report: CheckReport) -> None:
    """Time offset that is left between cameras, with its uncertainty and the limit of 5 ms."""
    known = {name: camera for name, camera in report.cameras.items() if camera.offset_ms is not None}
    names = list(known)
    values = np.array([camera.offset_ms for camera in known.values()], float)
    spread = np.array([camera.offset_uncertainty_ms or 0.0 for camera in known.values()], float)
    title = "Time against the other cameras (bars: two standard deviations)"
    figure, axis = _chart(names, title, "late by, milliseconds")
    axis.axhspan(-LIMIT_MS, LIMIT_MS, color="#e8f4ec", zorder=0)
    for side in (-LIMIT_MS, LIMIT_MS):
        axis.axhline(side, color=COLORS[2], linewidth=1, linestyle="--")
    axis.annotate(
        "5 ms", (1.0, LIMIT_MS), xycoords=("axes fraction", "data"), fontsize=8, color=COLORS[2], ha="left", va="center"
    )
    axis.errorbar(range(len(names)), values, yerr=2 * spread, fmt="o", color=COLORS[0], markersize=5, capsize=3)
    limit = max(2 * LIMIT_MS, 1.2 * float((np.abs(values) + 2 * spread).max(initial=0)))
    axis.set_ylim(-limit, limit)
    save_figure(figure, path)


def _chart(names: Sequence[str], title: str, label: str) -> "tuple[Figure, Axes]":
    """A chart with a value for each camera."""
    figure = figure_of(max(6.0, 0.36 * len(names) + 2.4), 3.6)
    axis = figure.subplots()
    axis.axhline(0, color=INK, linewidth=0.8)
    axis.set_xticks(range(len(names)), names, rotation=90 if len(names) > 12 else 0, fontsize=8)
    axis.set_ylabel(label, fontsize=8)
    axis.set_title(title, fontsize=10, loc="left", color=INK)
    without_frame(axis)
    return figure, axis


def _level_frame(examined: Examination, centers: Floats) -> Floats:
    """Rows: across, into the scene, up, where up is perpendicular to the cameras' x axes."""
    up = level_normal(examined.cameras)
    spread = centers - centers.mean(0)
    spread = spread - np.outer(spread @ up, up)
    across = np.linalg.svd(spread, full_matrices=False)[2][0] if len(spread) > 1 else np.array([1.0, 0, 0])
    across = across - (across @ up) * up
    across /= max(float(np.linalg.norm(across)), 1e-12)
    into = np.cross(up, across)
    ahead = np.mean([camera.viewmat.numpy()[2, :3] for camera in examined.cameras.values()], axis=0)
    if ahead @ into < 0:  # the cameras at the bottom, what they see above
        across, into = -across, -into
    return np.stack([across, into, up])


def _within(points: Floats, counts: np.ndarray, centers: Floats) -> tuple[Floats, np.ndarray]:
    """Without the few points far away, which would make the rig a dot."""
    if not len(points):
        return points, counts
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    reach = max(float(np.percentile(distances, FAR_PERCENTILE)), 1e-9)
    reach = min(reach, 6 * max(float(np.linalg.norm(centers - np.median(points, axis=0), axis=1).max()), 1e-9))
    return points[distances <= reach], counts[distances <= reach]


def _draw_labels(
    axis: "Axes", examined: Examination, labels: Sequence[str], places: Floats, ahead: Floats, *, radius: float
) -> None:
    """Names of cameras behind them; ``places`` and directions ``ahead`` ``[C, 2]`` are of all cameras."""
    order, off = list(examined.cameras), set(examined.suspects.off)
    for group in _near_ones([order.index(name) for name in labels], places, reach=LABEL_REACH * radius):
        names = [order[number] for number in group]
        first, away = group[0], 5 + 4 * len(names)
        length = float(np.linalg.norm(ahead[first]))
        ahead_of = ahead[first] / length if length > 1e-9 else np.array([0.0, -1.0])
        axis.annotate(
            "\n".join(names), tuple(places[first] - 0.05 * radius * ahead[first]), fontsize=7,
            color=COLORS[3] if off.intersection(names) else INK, ha="center", va="center",
            xytext=(-away * ahead_of[0], -away * ahead_of[1]), textcoords="offset points",
        )  # fmt: skip


def _near_ones(numbers: Sequence[int], places: Floats, *, reach: float) -> list[list[int]]:
    """Cameras grouped by place ``[C, 2]``, as those above each other would have labels on top of each other."""
    groups: list[list[int]] = []
    for number in numbers:
        near = (group for group in groups if np.linalg.norm(places[number] - places[group[0]]) < reach)
        if (group := next(near, None)) is None:
            groups.append([number])
        else:
            group.append(number)
    return groups


WIDTH_INCHES = 7.0
MAX_POINTS = 400
LINES = 7
USUAL_PERCENTILE = 75  # of the matches of a pair, by their distance to their lines
MAX_PAIRS = 6


def draw_overlay(path: Path, examined: Examination, report: CheckReport, name: str) -> None:
    """A camera's picture; the colour of each keypoint is its distance from where the other cameras' point falls."""
    camera, tracks = examined.cameras[name], examined.tracks
    figure = figure_of(WIDTH_INCHES, 0.9 * WIDTH_INCHES * camera.height / camera.width + 0.4)
    axis = figure.subplots()
    _picture(axis, examined, name)
    own = np.flatnonzero(tracks.of(name) & np.isfinite(tracks.residuals))
    own = own[:: max(len(own) // MAX_POINTS, 1)]
    limit = 2 * examined.suspects.limit_pixels
    if len(own):
        order = own[np.argsort(tracks.residuals[own])]
        shown = axis.scatter(
            *tracks.pixels[order].T, c=np.minimum(tracks.residuals[order], limit), cmap="plasma", vmin=0, vmax=limit,
            s=16, edgecolors="white", linewidths=0.4,
        )  # fmt: skip
        options = {"ax": axis, "shrink": 0.8, "pad": 0.01, "aspect": 30, "extend": "max"}
        _add_bar(figure, shown, "reprojection error, pixels", **options)
    found = report.cameras[name]
    median = "none" if found.reprojection_pixels is None else f"{found.reprojection_pixels:.2f} px"
    off = " - OFF" if name in examined.suspects.off else ""
    title = f"{name}{off}: median error {median}, {found.points} points, matches with {found.overlaps} cameras"
    axis.set_title(title, fontsize=10, color=COLORS[3] if off else INK, loc="left")
    save_figure(figure, path)


def chosen_pairs(examined: Examination) -> list[Pair]:
    """Pairs to draw: the worst of each camera that is off, the worst and the best of the others."""
    errors = pair_errors(examined.evidence, examined.cameras)
    ranked = sorted(errors, key=lambda pair: -errors[pair].pixels)
    chosen: list[Pair] = []
    for name in examined.suspects.off[: MAX_PAIRS - 2]:
        chosen += [pair for pair in ranked if name in pair][:1]
    solid = sorted(ranked, key=lambda pair: -errors[pair].matches)
    chosen += [*ranked[:1], *solid]
    return list(dict.fromkeys(chosen))[:MAX_PAIRS]


def draw_epipolar(path: Path, examined: Examination, pair: Pair) -> None:
    """Both pictures of a pair: matched keypoints, and in the second the lines on which they lie by the poses."""
    first, second = (examined.cameras[name] for name in pair)
    pixels1, pixels2 = examined.evidence.pixels(pair)
    error = pair_errors(examined.evidence, examined.cameras)[pair]
    fundamental = fundamental_matrix(first, second)
    off = epipolar_errors(fundamental, pixels1, pixels2)
    # Wrong matches lie at the rims, where they would be drawn before all others.
    usual = np.flatnonzero(off <= np.percentile(off, USUAL_PERCENTILE))
    chosen = usual[_spread(pixels1[usual], LINES)]
    share = first.height / first.width
    figure = figure_of(2 * WIDTH_INCHES * 0.8, 0.8 * WIDTH_INCHES * share + 0.6)
    left, right = figure.subplots(1, 2)
    lines = np.column_stack([pixels1, np.ones(len(pixels1))]) @ fundamental.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    for axis, name in ((left, pair[0]), (right, pair[1])):
        _picture(axis, examined, name)
        axis.set_title(name, fontsize=10, color=INK, loc="left")
    for number, row in enumerate(chosen):
        color = COLORS[number % (len(COLORS) - 1)]
        normal, distance = lines[row, :2], lines[row] @ [*pixels2[row], 1.0]
        foot = pixels2[row] - distance * normal
        for under, width in (("white", 2.2), (color, 1.2)):
            right.axline(foot, foot + second.width * np.array([normal[1], -normal[0]]), color=under, linewidth=width)
        for axis, pixels in ((left, pixels1), (right, pixels2)):
            axis.plot(*pixels[row], "o", color=color, markeredgecolor="white", markeredgewidth=0.8, markersize=6)
    text = f"{error.matches} matches, median distance to their lines {error.pixels:.2f} pixels"
    if pair in examined.suspects.stray:
        text += ": both cameras fit others, so most likely these matches are wrong"
    figure.suptitle("\n".join(textwrap.wrap(text, 110)), fontsize=10, color=INK)
    save_figure(figure, path)


def _picture(axis: "Axes", examined: Examination, name: str) -> None:
    camera = examined.cameras[name]
    axis.imshow(examined.frame.images[name], extent=(0, camera.width, camera.height, 0), interpolation="antialiased")
    axis.set_xlim(0, camera.width)
    axis.set_ylim(camera.height, 0)
    axis.set_axis_off()


def _spread(pixels: np.ndarray, count: int) -> Sequence[int]:
    """Rows far from each other: each next one is the farthest from those chosen."""
    chosen = [int(np.argmin(((pixels - pixels.mean(0)) ** 2).sum(1)))]
    distances = np.full(len(pixels), np.inf)
    while len(chosen) < min(count, len(pixels)):
        distances = np.minimum(distances, ((pixels - pixels[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(distances.argmax()))
    return chosen


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
    """The page's HTML; cameras ``off`` are marked, and ``sections`` map a heading to file names of pictures in the
    folder."""
    findings = "".join(f"<li class={found.severity}>{escape(found.sentence)}</li>" for found in report.findings)
    parts = [
        f"<!doctype html>\n<html lang=en><meta charset=utf-8><title>{escape(report.capture)}: check</title>",
        "<meta name=viewport content='width=device-width'>",
        f"<style>{STYLE}</style><h1>{escape(report.capture)}</h1>",
        f"<p class=sub>{escape(_facts(report))}</p>",
        f"<ul class=findings>{findings or '<li class=fine>Nothing is wrong.</li>'}</ul>",
    ]
    if report.steps:
        rows = "".join(
            f"<tr><td>{escape(step)}<td class=text>{escape(str(summary))}" for step, summary in report.steps.items()
        )
        parts.append(f"<h2>Preparation</h2><table>{rows}</table>")
    head = "".join(f"<th>{title}" for title, _, _ in COLUMNS)
    rows = ""
    for name, camera in report.cameras.items():
        values = ((getattr(camera, key), text) for _, key, text in COLUMNS)
        cells = "".join(f"<td>{'-' if value is None else text.format(value)}" for value, text in values)
        rows += f"<tr{' class=off' if name in off else ''}><td>{escape(name)}{cells}"
    parts.append(f"<h2>Cameras</h2><div class=wide><table><tr><th>camera{head}{rows}</table></div>")
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


PAGE, NUMBERS = "index.html", "report.json"
PURPOSE = "report of a check"
DRAWN = re.compile(r"(camera|lines)_\d+\.png|times\.png|colors\.png")
"""Pictures that another capture, or another check, may have fewer of."""


def write_report(folder: Path, checked: Checked, *, listener: Listener | None = None) -> Path:
    """The report in ``folder``, in place of an earlier one; returns the page. Raises StorageError if the folder holds
    something else or cannot be written."""
    report, examined = checked.report, checked.examination
    own_folder(folder, PURPOSE)
    remove_own(folder, PURPOSE, DRAWN)
    listener = listener or Silent()
    pairs = chosen_pairs(examined)
    total = len(examined.cameras) + len(pairs)
    overlays, lines = [], []
    for number, name in enumerate(examined.cameras):
        listener.progress(number, total, f"picture of {name}")
        overlays.append(f"camera_{number}.png")
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
