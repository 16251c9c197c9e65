# SPDX-License-Identifier: Apache-2.0
"""What each camera saw, with the points of the others projected into it, and epipolar lines of pairs."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from structgstream.data.matching import Pair, epipolar_errors, fundamental_matrix
from structgstream.figure import COLORS, INK, figure_of, save_figure
from structgstream.pose_check.evidence import pair_errors
from structgstream.preparation.checking.check import Examination
from structgstream.preparation.checking.findings import CheckReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH_INCHES = 7.0
MAX_POINTS = 400
LINES = 7
USUAL_PERCENTILE = 75  # of the matches of a pair, by their distance to their lines
MAX_PAIRS = 6


def draw_overlay(path: Path, examined: Examination, report: CheckReport, name: str) -> None:
    """A camera's picture; each keypoint is joined with where the point of the other cameras falls.

    Raises:
        MissingExtraError: matplotlib is not installed.
        StorageError: the file cannot be written.
    """
    camera, tracks = examined.cameras[name], examined.tracks
    figure = figure_of(WIDTH_INCHES, 0.9 * WIDTH_INCHES * camera.height / camera.width + 0.4)
    axis = figure.subplots()
    _picture(axis, examined, name)
    own = np.flatnonzero(tracks.of(name) & np.isfinite(tracks.residuals)) if name in tracks.names else np.empty(0, int)
    own = own[:: max(len(own) // MAX_POINTS, 1)]
    limit = 2 * examined.suspects.limit_pixels
    if len(own):
        order = own[np.argsort(tracks.residuals[own])]
        shown = axis.scatter(
            *tracks.pixels[order].T,
            c=np.minimum(tracks.residuals[order], limit),
            cmap="plasma",
            vmin=0,
            vmax=limit,
            s=16,
            edgecolors="white",
            linewidths=0.4,
        )
        bar = figure.colorbar(shown, ax=axis, shrink=0.8, pad=0.01, aspect=30, extend="max")
        bar.set_label("reprojection error, pixels", fontsize=8, color=INK)
        bar.ax.tick_params(labelsize=8)
    found = report.cameras[name]
    median = "none" if found.reprojection_pixels is None else f"{found.reprojection_pixels:.2f} px"
    off = " - OFF" if name in examined.suspects.off else ""
    axis.set_title(
        f"{name}{off}: median error {median}, {found.points} points, matches with {found.overlaps} cameras",
        fontsize=10,
        color=COLORS[3] if off else INK,
        loc="left",
    )
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
    """Both pictures of a pair: matched keypoints, and in the second the lines on which the poses say that they lie.

    Raises:
        MissingExtraError: matplotlib is not installed.
        StorageError: the file cannot be written.
    """
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
    for axis, name in ((left, pair[0]), (right, pair[1])):
        _picture(axis, examined, name)
        axis.set_title(name, fontsize=10, color=INK, loc="left")
    for number, row in enumerate(chosen):
        color = COLORS[number % (len(COLORS) - 1)]
        a, b, c = lines[row]
        ends = _across(a, b, c, second.width, second.height)
        if len(ends) == 2:
            right.plot(*np.array(ends).T, color="white", linewidth=2.2)
            right.plot(*np.array(ends).T, color=color, linewidth=1.2)
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
    apart = np.full(len(pixels), np.inf)
    while len(chosen) < min(count, len(pixels)):
        apart = np.minimum(apart, ((pixels - pixels[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(apart.argmax()))
    return chosen


def _across(a: float, b: float, c: float, width: int, height: int) -> list[tuple[float, float]]:
    """Where the line ``ax + by + c = 0`` meets the border of a picture: two points, or none."""
    ends = []
    if abs(b) > 1e-12:
        ends += [(x, -(a * x + c) / b) for x in (0.0, float(width))]
    if abs(a) > 1e-12:
        ends += [(-(b * y + c) / a, y) for y in (0.0, float(height))]
    inside = [(x, y) for x, y in ends if -1e-6 <= x <= width + 1e-6 and -1e-6 <= y <= height + 1e-6]
    return [min(inside), max(inside)] if len(inside) >= 2 else []
