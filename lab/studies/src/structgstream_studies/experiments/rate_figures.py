# SPDX-License-Identifier: Apache-2.0
"""Plots of rate-distortion curves."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from structgstream.figure import COLORS, INK, figure_of, save_figure, without_frame
from structgstream_studies.experiments.rate_distortion import JUDGED, OTHERS, QUALITIES, quality_key
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import SCORES
from structgstream_studies.experiments.summary import Summary, summaries

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_rates(path: Path, results: Iterable[Result]) -> None:
    """Quality against kilobytes a frame, of all pixels and of those that changed: the curve, and methods as points.

    Bars are the spread over seeds. Methods without a result are left out.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    found = summaries(results)
    curve = [found[key] for key in map(quality_key, QUALITIES) if key in found]
    figure = figure_of(10.0, 4.2)
    for axis, (score, title) in zip(figure.subplots(1, len(JUDGED)), JUDGED.items()):
        _points(axis, curve, score, line="-o", colour=INK, label="compact")
        for number, (key, name) in enumerate(OTHERS.items()):
            if key in found:
                _points(axis, [found[key]], score, line="s", colour=COLORS[number], label=name)
        axis.set_xscale("log")
        axis.margins(x=0.1, y=0.12)
        axis.set_xlabel("KB a frame after the first", fontsize=9)
        axis.set_ylabel(f"{title}, held-out cameras, dB", fontsize=9)
        without_frame(axis)
        if axis.has_data():
            axis.legend(fontsize=8, frameon=False, loc="lower right")
    save_figure(figure, path)


def _points(axis: "Axes", shown: Sequence[Summary], score: str, *, line: str, colour: str, label: str) -> None:
    values = [(one.score("online_bytes"), one.score(score)) for one in shown]
    known = [(cost, quality) for cost, quality in values if cost is not None and quality is not None and cost.mean > 0]
    if not known:
        return
    factor = SCORES["online_kilobytes"].factor
    axis.errorbar(
        [cost.mean * factor for cost, _ in known],
        [quality.mean for _, quality in known],
        xerr=[cost.deviation * factor for cost, _ in known],
        yerr=[quality.deviation for _, quality in known],
        fmt=line, color=colour, markersize=5, linewidth=1.4, elinewidth=0.8, label=label,
    )  # fmt: skip
