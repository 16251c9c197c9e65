# SPDX-License-Identifier: Apache-2.0
"""``structgstream dataset``."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError
from structgstream.cli.options import CaptureOptions, Folder, parse_options
from structgstream.cli.progress import print_lines
from structgstream_studies.cli.experiment import ExperimentOptions, capture_part, print_sheet, run_sweep


@dataclass(frozen=True)
class Dataset(ExperimentOptions):
    """Runs a preset on every capture of a data set of the paper, and prints the mean over them as a row of the paper's
    table, beside the rows that the paper prints.

    The scale of the pictures and the held-out camera are the paper's unless given. FOLDER gets dataset.md, and a folder
    of streams and results for each capture. After an interruption the same command continues.

    Example: structgstream dataset n3dv/ n3dv -o n3dv-ours --seeds 0
    """

    scenes: tyro.conf.Positional[Folder] = tyro.MISSING
    """Folder of the captures, each a folder of its own."""
    data: tyro.conf.Positional[Literal["n3dv", "meetroom", "immersive"]] = tyro.MISSING
    """The data set."""
    preset: str | None = None
    """What reconstructs. Default: paper-DATA."""


def captures_in(folder: Path) -> list[Path]:
    """The captures of a folder, by name.

    Raises:
        UsageError: there is none.
    """
    found = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    if not found:
        raise UsageError(f"{folder} has no folders of captures.")
    return found


def main(arguments: list[str]) -> None:
    """Runs and prints."""
    options = parse_options(Dataset, "dataset", arguments=arguments)
    from structgstream.session.presets import PAPER_DATA, preset_named
    from structgstream_studies.experiments.cited import dataset_sheet
    from structgstream_studies.experiments.sheets import markdown
    from structgstream_studies.experiments.studies import results_of, with_dependencies
    from structgstream_studies.experiments.tasks import VariantRun

    used, config = PAPER_DATA[f"paper-{options.data}"], preset_named(options.preset or f"paper-{options.data}")
    asked = options.capture
    if asked.scale == CaptureOptions().scale:
        asked = replace(asked, scale=used.scale)
    if asked.held_out is None:
        asked = replace(asked, held_out=(used.held_out_camera,))
    runs: list[VariantRun] = []
    for scene in captures_in(options.scenes):
        part, frames = capture_part(scene, replace(options, capture=asked))
        folder = options.output / scene.name
        runs += [VariantRun("full", part, replace(config, seed=seed), folder, frames) for seed in options.seeds]
    for scene in dict.fromkeys(run.folder for run in runs):
        run_sweep(with_dependencies(run for run in runs if run.folder == scene), options)
    sheet = dataset_sheet(options.data, results_of(runs), name=options.preset or f"paper-{options.data}")
    (options.output / "dataset.md").write_text(f"# {sheet.title}\n\n{markdown(sheet)}")
    console = Console()
    print_sheet(sheet, console)
    print_lines(console, f"Table: {options.output / 'dataset.md'}")
