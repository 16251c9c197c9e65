# SPDX-License-Identifier: Apache-2.0
"""Plots a live run from its log: ``python lab/robustness/plot_live.py build/now.log.jsonl build/now.png``.

Memory, age of the pictures when they were handed to the trainer, skipped sets and absent cameras, over the time filmed.
"""

import argparse
import json
from pathlib import Path

from structgstream.figure import COLORS, figure_of, save_figure, without_frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    entries = [json.loads(line) for line in options.log.read_text().splitlines()]
    minutes = [entry["pts_seconds"] / 60 for entry in entries]
    runs = [entry["run"] for entry in entries]
    rows = {
        "memory, MB": [run["resident_bytes"] / 1e6 for run in runs],
        "age of pictures, s": [run["live"]["delay_seconds"] for run in runs],
        "sets skipped": [run["live"]["skipped_sets"] for run in runs],
        "cameras absent": [len(entry.get("absent", ())) for entry in entries],
    }
    figure = figure_of(8, 6)
    axes = figure.subplots(len(rows), sharex=True)
    for axis, color, (name, values) in zip(axes, COLORS, rows.items(), strict=False):
        axis.plot(minutes, values, color=color, linewidth=1.2, drawstyle="steps-post")
        axis.set_ylim(bottom=0)
        axis.set_title(name, loc="left", fontsize=9)
        without_frame(axis)
    axes[-1].set_xlabel("minutes", fontsize=9)
    save_figure(figure, options.picture)


if __name__ == "__main__":
    main()
