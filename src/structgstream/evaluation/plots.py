# SPDX-License-Identifier: Apache-2.0
"""Plots of a report over time, in one picture: quality, bytes, counts, seconds."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from structgstream.evaluation.report import FrameScores, Report
from structgstream.figure import COLORS, INK, OTHER, figure_of, save_figure, without_frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DISTANCES = (("flip", "FLIP"), ("lpips_alex", "LPIPS, AlexNet"), ("lpips_vgg", "LPIPS, VGG16"))
FLICKER = (("flicker", "rendering"), ("truth_flicker", "truth"))


def write_plots(path: Path, report: Report, *, title: str) -> None:
    """Panels over the frame number: PSNR by camera, distances, flicker, ghosts, bytes by field, counts, seconds.

    Seconds need the trainer's log; distances (FLIP, LPIPS) and flicker are shown if they were computed.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    panels: list[Callable[[Axes, Report], None]] = [_quality]
    for lines, label in ((DISTANCES, "distance"), (FLICKER, "flicker, levels")):
        if any(_known(report, key) for key, _ in lines):
            panels.append(partial(_lines, keys=lines, label=label))
    if _known(report, "ghost_share"):
        panels.append(_ghosts)
    panels += [_bytes, _counts]
    if any(_stages(frame) for frame in report.frames):
        panels.append(_seconds)
    figure = figure_of(10.0, 2.6 * len(panels) + 0.6)
    figure.suptitle(title, fontsize=11, fontweight="bold", color=INK)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, panel in zip(axes, panels, strict=True):
        panel(axis, report)
        without_frame(axis)
        axis.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
    axes[-1].set_xlabel("frame", fontsize=9)
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    save_figure(figure, path)


def _quality(axis: "Axes", report: Report) -> None:
    index = [frame.index for frame in report.frames]
    for number, name in enumerate(report.cameras):
        scores = [frame.cameras.get(name) for frame in report.frames]
        values = [float("nan") if found is None else found.psnr for found in scores]
        axis.plot(index, values, color=COLORS[number % len(COLORS)], linewidth=1, alpha=0.75, label=f"camera {name}")
    if len(report.cameras) > 1:
        axis.plot(*zip(*_known(report, "psnr")), color=INK, linewidth=2, label="mean")
    if colored := _known(report, "psnr_camera_color"):
        axis.plot(*zip(*colored), color=INK, linewidth=1.5, linestyle="--", label="mean, frame 0's colour fit")
    if changed := _known(report, "psnr_changed"):
        axis.plot(*zip(*changed), color=INK, linewidth=1, linestyle=":", label="changed pixels")
    for key, style, label in (("psnr_half", "-.", "half size"), ("psnr_stored", ":", "stored size")):
        if points := _known(report, key):
            axis.plot(*zip(*points), color=OTHER, linewidth=1.5, linestyle=style, marker=".", markersize=3, label=label)
    axis.set_ylabel("PSNR, dB", fontsize=9)


def _ghosts(axis: "Axes", report: Report) -> None:
    for colour, name in zip(cycle(COLORS), report.cameras):
        pairs = [(frame.index, frame.cameras[name].ghost_share) for frame in report.frames if name in frame.cameras]
        points = [(index, 100 * share) for index, share in pairs if share is not None]
        if points:
            axis.plot(*zip(*points), color=colour, linewidth=1, alpha=0.75, label=f"camera {name}")
    points = [(index, 100 * share) for index, share in _known(report, "ghost_share")]
    axis.plot(*zip(*points), color=INK, linewidth=2, label="all")
    axis.set_ylim(bottom=0)
    axis.set_ylabel("ghosts, % of disoccluded", fontsize=9)


def _lines(axis: "Axes", report: Report, *, keys: Sequence[tuple[str, str]], label: str) -> None:
    """Plots the mean over cameras of metrics whose best value is 0, each always in the same colour."""
    largest = 0.0
    for colour, (key, name) in zip(COLORS, keys):
        if points := _known(report, key):
            axis.plot(*zip(*points), color=colour, linewidth=1.5, label=name)
            largest = max(largest, *(value for _, value in points))
    axis.set_ylim(0, 1.1 * largest or None)  # Automatic margins of nearly constant values would cut the line.
    axis.set_ylabel(label, fontsize=9)


def _known(report: Report, key: str) -> list[tuple[int, float]]:
    """Frame number and mean of a score, for the frames that have one."""
    values = [(frame.index, getattr(frame.mean, key)) for frame in report.frames if frame.mean is not None]
    return [(index, value) for index, value in values if value is not None]


def _bytes(axis: "Axes", report: Report) -> None:
    _stacked(axis, report, [{name: size / 1000 for name, size in one.field_bytes.items()} for one in report.frames])
    axis.set_ylabel("kB", fontsize=9)


def _seconds(axis: "Axes", report: Report) -> None:
    stages = [_stages(frame) for frame in report.frames]
    _stacked(axis, report, stages)
    first = sum(stages[0].values())
    online = [sum(own.values()) for frame, own in zip(report.frames, stages) if frame.index > 0]
    if online and first > 3 * max(online):
        axis.set_ylim(0, 1.3 * max(online))
        axis.annotate(
            f"first frame: {first:.0f} s", (report.frames[0].index + 0.5, 1.2 * max(online)), xytext=(8, 0),
            textcoords="offset points", fontsize=8, color=INK, va="center",
        )  # fmt: skip
    axis.set_ylabel("seconds", fontsize=9)


def _counts(axis: "Axes", report: Report) -> None:
    index = [frame.index for frame in report.frames]
    axis.plot(index, [frame.anchors for frame in report.frames], color=COLORS[0], linewidth=1.5, label="anchors")
    axis.plot(index, [frame.free for frame in report.frames], color=COLORS[3], linewidth=1.5, label="free Gaussians")
    axis.set_ylim(bottom=0)
    axis.set_ylabel("count", fontsize=9)


def _stacked(axis: "Axes", report: Report, parts: Sequence[Mapping[str, float]]) -> None:
    """Stacked bars of each frame's parts, the largest lowest, without those below a thousandth of the total."""
    index = [frame.index for frame in report.frames]
    names = dict.fromkeys(name for own in parts for name in own)
    values = {name: np.array([own.get(name, 0.0) for own in parts]) for name in names}
    whole = sum(array.sum() for array in values.values())
    shown = sorted((name for name in values if values[name].sum() > whole / 1000), key=lambda n: -values[n].sum())
    base = np.zeros(len(index))
    # Colours that are used a second time are hatched, so that no two fields look alike.
    looks = cycle(product((None, "////", "...."), COLORS))
    for name in shown:
        hatch, colour = (None, OTHER) if name == "other" else next(looks)
        style = {"color": colour, "hatch": hatch, "edgecolor": "white", "lw": 0, "label": name.replace("_", " ")}
        axis.bar(index, values[name], bottom=base, width=0.85, **style)
        base = base + values[name]


def _stages(frame: FrameScores) -> dict[str, float]:
    """Seconds by stage and the remainder, without the log's totals, so that the bars sum to the totals."""
    seconds = dict(frame.log.get("seconds", {}))
    total = seconds.pop("total", 0.0)
    seconds.pop("fit", None)
    rest = total - sum(seconds.values())
    return seconds | {"other": rest} if rest > 0.0 else seconds
