# SPDX-License-Identifier: Apache-2.0
"""``structgstream compare``."""

from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError
from structgstream.cli.options import Folder, parse_options
from structgstream.cli.progress import print_lines
from structgstream_studies.cli.experiment import ExperimentOptions, capture_part, print_sheet, run_sweep


@dataclass(frozen=True)
class Compare(ExperimentOptions):
    """Runs several methods on one capture and scores their files with the same evaluator.

    FOLDER gets methods.md, methods.png (quality against bytes and seconds) and methods-detail.png, results/ with all
    results as JSON, and streams/. After an interruption the same command continues.

    Example: structgstream compare basketball -o methods --frames 20 --methods rig held 3dgstream
    """

    scene: tyro.conf.Positional[Folder] = tyro.MISSING
    """The capture."""
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="METHOD [METHOD ...]", help_behavior_hint="")] = (
        "rig",
        "held",
        "3dgstream",
        "scaffold-gs",
        "3dgs",
    )
    """Presets of ours (rig, motion, fast, ...), held (frame 0 repeated), 3dgstream (a transformation cache per frame
    and added Gaussians), and scaffold-gs and 3dgs (every frame from scratch)."""
    scratch_every: int = 5
    """Step between the frames of methods that fit every frame from scratch, which takes hours."""


def main(arguments: list[str]) -> None:
    """Runs, prints, draws."""
    options = parse_options(Compare, "compare", arguments=arguments)
    if options.scratch_every < 1:
        raise UsageError(f"--scratch-every counts frames, from 1; got {options.scratch_every}.")
    capture, frames = capture_part(options.scene, options)
    from structgstream.kernels.backend import select_backend
    from structgstream_studies.experiments.studies import comparison_runs, with_dependencies, write_methods

    runs = comparison_runs(
        options.methods,
        capture,
        frames=frames,
        alone_every=options.scratch_every,
        seeds=options.seeds,
        folder=options.output,
    )
    run_sweep(with_dependencies(runs), options)
    console = Console()
    print_sheet(write_methods(options.output, runs, backend=select_backend(options.device)), console)
    print_lines(console, f"Table and pictures: {options.output}")
