# SPDX-License-Identifier: Apache-2.0
"""Results as pictures: curves over the frames, methods against bytes and seconds, variants side by side."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from structgstream.figure import COLORS, INK, OTHER, figure_of, save_figure, without_frame
from structgstream_studies.experiments.cited import online_rows
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import SCORES
from structgstream_studies.experiments.summary import Summary, summaries
from structgstream_studies.experiments.variants import FULL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Picture = NDArray[np.uint8]
CROP_SHARE = 4  # a detail is a quarter of the picture across
CHANGE_GAIN = 8
CITED_DATA, CITED_MARKS = "n3dv", "sv^D"
CURVES = ("psnr", "psnr_camera_color", "psnr_changed", "e_warp", "flicker")


def write_curves(path: Path, results: Iterable[Result], *, keys: Sequence[str], titles: Mapping[str, str]) -> None:
    """Scores over the frames, a line for each variant, with the spread over seeds as a band.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    found = summaries(results)
    shown = [name for name in CURVES if any(_known(found[key], name) for key in keys if key in found)]
    figure = figure_of(9.0, 2.4 * len(shown) + 0.4)
    axes = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for axis, name in zip(axes, shown):
        for number, key in enumerate(key for key in keys if key in found):
            colour = INK if key == FULL else COLORS[number % len(COLORS)]
            _curve(axis, found[key], name, label=titles[key], colour=colour, width=2.0 if key == FULL else 1.2)
        axis.set_ylabel(SCORES[name].title, fontsize=9)
        without_frame(axis)
    axes[0].legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
    axes[-1].set_xlabel("frame", fontsize=9)
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    save_figure(figure, path)


def write_comparison(path: Path, results: Iterable[Result], *, titles: Mapping[str, str]) -> None:
    """Quality against bytes and against seconds, a point for each method, bars for the spread over seeds; hollow marks
    for the online methods as the paper cites them on N3DV, which are of other data and a GPU's seconds.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    found = summaries(results)
    figure = figure_of(10.0, 4.2)
    axes = figure.subplots(1, 2, sharey=True)
    points: dict[str, Any] = {}
    panels = (
        ("online_bytes", "MB a frame after the first"),
        ("online_cpu_seconds", "core-seconds a frame; cited: seconds on a GPU"),
    )
    for axis, (name, caption) in zip(axes, panels):
        for number, key in enumerate(key for key in titles if key in found):
            cost, quality = found[key].score(name), found[key].score("psnr")
            if cost is None or quality is None:
                continue
            x = max(cost.mean * SCORES[name].factor, 1e-4)
            colour = INK if key == FULL else COLORS[number % len(COLORS)]
            spread = quality.deviation
            points[titles[key]] = axis.errorbar(x, quality.mean, yerr=spread, fmt="o", color=colour, capsize=3)
        for row, mark in zip(online_rows(CITED_DATA), CITED_MARKS):
            x = float(row.megabytes) if name == "online_bytes" else 60.0 * float(row.minutes)
            (point,) = axis.plot(x, float(row.psnr), mark, color=OTHER, fillstyle="none", markeredgewidth=1.6)
            points[f"{row.method}, cited"] = point
        axis.set_xscale("log")
        axis.margins(x=0.12, y=0.12)
        axis.set_xlabel(caption, fontsize=9)
        without_frame(axis)
    axes[0].set_ylabel("PSNR of held-out cameras, dB", fontsize=9)
    # Beside the panels: methods lie so near to each other that names at the points would cover one another.
    beside = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
    axes[-1].legend(points.values(), points.keys(), fontsize=8, frameon=False, **beside)
    save_figure(figure, path)


def write_details(path: Path, pictures: Mapping[str, Picture], truth: Picture, *, title: str) -> None:
    """The part of a picture in which the variants differ most, as each shows it and as it was, magnified.

    Args:
        path: the PNG.
        pictures: rendering ``[H, W, 3]`` by title.
        truth: what the camera took.
        title: a line above.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    top, left, height, width = most_varied_crop(pixel_range([*pictures.values(), truth]))
    cells = {**pictures, "ground truth": truth}
    columns = min(len(cells), 4)
    rows = -(-len(cells) // columns)
    figure = figure_of(3.2 * columns, 3.2 * rows * height / width + 0.35 * rows + 0.4)
    figure.suptitle(title, fontsize=10, fontweight="bold", color=INK)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, (name, picture) in zip(axes, cells.items()):
        axis.imshow(picture[top : top + height, left : left + width], interpolation="nearest")
        axis.set_title(name, fontsize=8)
    save_figure(figure, path)


def write_adjacent(
    path: Path, pictures: Mapping[str, Sequence[Picture]], truth: Sequence[Picture], *, title: str
) -> None:
    """The part of consecutive pictures that changes most beyond what the camera saw change, a row for each method, and
    beside it the change between the first two, :data:`CHANGE_GAIN` times as strong.

    Args:
        path: the PNG.
        pictures: renderings ``[H, W, 3]`` of consecutive frames by title.
        truth: what the camera took in these frames.
        title: a line above.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    real = pixel_range(truth[:2])
    beyond = [np.maximum(pixel_range(shown[:2]) - real, 0) for shown in pictures.values()]
    top, left, height, width = most_varied_crop(np.sum(beyond, axis=0))
    rows, columns = {**pictures, "ground truth": truth}, len(truth) + 1
    figure = figure_of(2.6 * columns, (2.6 * height / width + 0.3) * len(rows) + 0.4)
    figure.suptitle(title, fontsize=10, fontweight="bold", color=INK)
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for row, (name, shown) in zip(axes, rows.items(), strict=True):
        crops = [picture[top : top + height, left : left + width] for picture in shown]
        change = np.abs(crops[1].astype(np.int64) - crops[0]) * CHANGE_GAIN
        for axis, picture in zip(row, [*crops, change.clip(0, 255).astype(np.uint8)], strict=True):
            axis.imshow(picture, interpolation="nearest")
            axis.set_axis_off()
        row[0].set_title(name, fontsize=8, loc="left")
        row[-1].set_title(f"change, {CHANGE_GAIN} times", fontsize=8, loc="left")
    save_figure(figure, path)


def pixel_range(pictures: Sequence[Picture]) -> NDArray[np.int64]:
    """How far the pictures ``[H, W, 3]`` are apart in each pixel, ``[H, W]``: the range, summed over channels."""
    stack = np.stack(pictures).astype(np.int64)
    return (stack.max(0) - stack.min(0)).sum(-1)


def most_varied_crop(weights: NDArray[np.int64]) -> tuple[int, int, int, int]:
    """Top, left, height and width of the detail of ``weights`` ``[H, W]`` with the largest sum."""
    height, width = weights.shape[0] // CROP_SHARE, weights.shape[1] // CROP_SHARE
    total = np.pad(weights.cumsum(0, dtype=np.int64).cumsum(1), ((1, 0), (1, 0)))
    inside = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(top), int(left), height, width


def _known(summary: Summary, name: str) -> bool:
    return any(value is not None for value in summary.curve(name))


def _curve(axis: "Axes", summary: Summary, name: str, *, label: str, colour: str, width: float) -> None:
    points = [(i, value) for i, value in enumerate(summary.curve(name)) if value is not None]
    if not points:
        return
    factor = SCORES[name].factor
    index = [i for i, _ in points]
    mean = np.array([value.mean for _, value in points]) * factor
    deviation = np.array([value.deviation for _, value in points]) * factor
    axis.plot(index, mean, color=colour, linewidth=width, label=label)
    if deviation.any():
        axis.fill_between(index, mean - deviation, mean + deviation, color=colour, alpha=0.12, linewidth=0)
