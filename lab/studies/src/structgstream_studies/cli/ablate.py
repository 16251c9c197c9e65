# SPDX-License-Identifier: Apache-2.0
"""``structgstream ablate``."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from structgstream.cli.options import Folder, parse_known_options, resolve_config
from structgstream.cli.progress import print_lines
from structgstream.errors import ConfigError
from structgstream_studies.cli.experiment import ExperimentOptions, capture_part, print_sheet, run_sweep

if TYPE_CHECKING:
    from structgstream_studies.experiments.tasks import VariantRun

TableName = Literal["structured", "free", "patching", "distance", "readings", "effects", "rates"]


@dataclass(frozen=True)
class Ablate(ExperimentOptions):
    """Runs the paper's ablations on a capture, and prints our results beside the paper's figures; or the effect of each
    part of the compact stream (effects), and its rate-distortion curve (rates).

    Variants of one seed share frame 0. FOLDER gets TABLE.md, TABLE-curves.png and TABLE-detail.png for each table (and
    rates.png), results/ with all results as JSON, and streams/. After Ctrl-C or a crash the same command continues
    without losing a frame.

    Example: structgstream ablate basketball --table free -o ablations --frames 20

    Example: structgstream ablate basketball --table effects rates -o compact --frames 20 --held-out 0 10 15 30

    Example: structgstream ablate basketball -o ablations --preset fast --scale 0.5 --online.iterations 60
    """

    scene: tyro.conf.Positional[Folder] = tyro.MISSING
    """The capture."""
    table: Annotated[tuple[TableName, ...], tyro.conf.arg(metavar="TABLE [TABLE ...]", help_behavior_hint="")] = (
        "structured",
        "free",
        "patching",
        "distance",
    )
    """structured (fields trained online), free (generation and pruning), patching (inherited or independent),
    distance (the regularisation of frame 0); readings (points that the paper leaves open); effects (of the parts of
    the compact stream, each left out); rates (the compact stream at five qualities). Default: the first four."""
    rows: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROW [ROW ...]", help_behavior_hint="")] = ()
    """Rows of the tables to run, by key: the names of files in results/. Default: all."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """The full method that the variants edit. Default: rig, and compact for effects and rates."""


def main(arguments: list[str]) -> None:
    """Runs, prints, draws."""
    options, rest = parse_known_options(Ablate, "ablate", arguments=arguments)
    from structgstream.session.presets import DEFAULT_PRESET, PAPER_METHOD_PRESET

    full, _ = resolve_config(options.preset or PAPER_METHOD_PRESET, rest, command="ablate", seed=None)
    compact, _ = resolve_config(options.preset or DEFAULT_PRESET, rest, command="ablate", seed=None)
    paper, _ = resolve_config(PAPER_METHOD_PRESET, rest, command="ablate", seed=None)
    capture, frames = capture_part(options.scene, options)
    from structgstream.kernels.backend import select_backend
    from structgstream_studies.experiments.studies import (
        COMPACT_TABLES,
        ablation_runs,
        rows_of,
        with_dependencies,
        write_ablation,
    )

    known = dict.fromkeys(key for table in options.table for key in rows_of(table))
    if unknown := [key for key in options.rows if key not in known]:
        raise ConfigError(f"--rows {' '.join(unknown)}: the tables have the rows {', '.join(known)}.")
    runs: list[VariantRun] = []
    of_compact = [name for name in options.table if name in COMPACT_TABLES]
    others = [name for name in options.table if name not in COMPACT_TABLES]
    for tables, config in ((others, full), (of_compact, compact)):
        runs += ablation_runs(
            tables,
            config,
            capture,
            frames=frames,
            seeds=options.seeds,
            folder=options.output,
            paper=paper,
            rows=options.rows,
        )
    run_sweep(with_dependencies(runs), options)
    console = Console()
    for table in options.table:
        for sheet in write_ablation(options.output, table, runs, backend=select_backend(options.device)):
            print_sheet(sheet, console)
    print_lines(console, f"Tables and pictures: {options.output}")
