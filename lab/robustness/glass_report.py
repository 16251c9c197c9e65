# SPDX-License-Identifier: Apache-2.0
"""Results of ``lab.robustness.glass``, as Markdown and as a plot."""

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lab.robustness.glass_frames import STAGES
from structgstream.figure import COLORS, figure_of, save_figure, without_frame

Run = Mapping[str, Any]


def table(runs: Sequence[Run]) -> str:
    """Delays by stage, and frames, of all runs."""
    heads = ("stage", *(run["transport"] for run in runs))
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for stage in STAGES:
        lines.append(_line(f"until {stage}", [_delay(run, stage) for run in runs]))
    facts = {
        "sets that were filmed": [f"{run['sets']:,}" for run in runs],
        "frames written; shown": [f"{len(run['frames'])}; {len(_shown(run))}" for run in runs],
        "seconds from frame to frame": [f"{_step(run):.2f}" for run in runs],
        "the segments sink, ms a frame": [_writing(run) for run in runs],
        "errors of the page": [str(len(run["errors"])) for run in runs],
        "memory of the trainer: min 2, last, MB": [_memory(run, "trainer") for run in runs],
        "memory of the server": [_memory(run, "server") for run in runs],
        "processor seconds: trainer, server": [
            f"{run['busy_seconds']['trainer']:.0f}, {run['busy_seconds']['server']:.1f}" for run in runs
        ],
    }
    return "\n".join([*lines, *(_line(name, cells) for name, cells in facts.items())])


def plot(run: Run, path: Path) -> None:
    """Delay and memory over the minutes of a run."""
    figure = figure_of(8, 6)
    axes = figure.subplots(3, sharex=True)
    frames = [one for one in _shown(run) if one["frame"]]  # frame 0 takes ten times as long
    begun = run["frames"][0]["filmed"]
    minutes = [(one["filmed"] - begun) / 60 for one in frames]
    for color, stage in zip(COLORS, ("handed over", "written", "shown"), strict=False):
        axes[0].plot(minutes, [one[stage] for one in frames], color=color, linewidth=1, label=f"until {stage}")
    axes[0].set_title("delay, s", loc="left", fontsize=9)
    axes[0].legend(fontsize=8, frameon=False, ncols=3)
    for axis, color, name in zip(axes[1:], COLORS[3:], ("trainer", "server"), strict=False):
        start = run["memory"][name][0][0]
        axis.plot(
            [(at - start) / 60 for at, _ in run["memory"][name]],
            [size / 1e6 for _, size in run["memory"][name]],
            color=color,
            linewidth=1.2,
        )
        axis.set_title(f"memory of the {name}, MB", loc="left", fontsize=9)
    for axis in axes:
        axis.set_ylim(0, 1.15 * axis.get_ylim()[1])
        without_frame(axis)
    axes[-1].set_xlabel("minutes", fontsize=9)
    save_figure(figure, path)


def _line(name: str, cells: Sequence[str]) -> str:
    return f"| {' | '.join((name, *cells))} |"


def _shown(run: Run) -> list[Mapping[str, float]]:
    return [one for one in run["frames"] if one["shown"] is not None]


def _delay(run: Run, stage: str) -> str:
    found = sorted(one[stage] for one in run["frames"] if one[stage] is not None)
    return f"{statistics.median(found):.2f}, {found[int(0.95 * len(found))]:.2f}" if found else "-"


def _step(run: Run) -> float:
    filmed = [one["filmed"] + one["written"] for one in run["frames"]]
    return (filmed[-1] - filmed[0]) / max(len(filmed) - 1, 1)


def _writing(run: Run) -> str:
    found = sorted(1e3 * (one["written"] - one["encoded"]) for one in run["frames"])
    return f"{statistics.median(found):.1f}, {found[int(0.95 * len(found))]:.1f}"


def _memory(run: Run, name: str) -> str:
    samples = run["memory"][name]
    start = samples[0][0]
    second = next((size for at, size in samples if at - start > 120), samples[-1][1])
    return f"{second / 1e6:.0f}, {samples[-1][1] / 1e6:.0f}"
