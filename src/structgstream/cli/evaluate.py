# SPDX-License-Identifier: Apache-2.0
"""``structgstream evaluate``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from structgstream.cli.options import (
    Device,
    Folder,
    JsonPath,
    StreamFile,
    check_ending,
    parse_options,
    write_json_output,
)
from structgstream.cli.progress import print_lines
from structgstream.cli.tables import quality_text, report_tables

if TYPE_CHECKING:
    from structgstream.codec.reader import StreamReader
    from structgstream.data.source import FrameSource
    from structgstream.evaluation.optional_metrics import MetricSelection
    from structgstream.evaluation.report import Report
    from structgstream.kernels.backend import Backend

SHEET_COLUMNS = 5


@dataclass(frozen=True)
class Evaluate:
    """Scores a stream file against the held-out cameras.

    Everything is decoded from the file. Definitions of the metrics: docs/evaluation.md.

    Example: structgstream evaluate ball.sgs basketball --json ball.json --report ball-report
    """

    stream: tyro.conf.Positional[StreamFile]
    """The stream file."""
    scene: tyro.conf.Positional[Folder]
    """The capture that it was made from."""
    cameras: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="CAMERA [CAMERA ...]", help_behavior_hint="")] = (
        None
    )
    """Cameras to score. Default: the held-out ones."""
    json: JsonPath = None
    """Write every number to this file, - is standard output (keys: docs/evaluation.md)."""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Write report.json and a page of the worst frames, plots over time and a contact sheet into this folder."""
    metrics: Literal["all", "basic"] = "all"
    """Metrics: "basic" leaves out MS-SSIM, FLIP, LPIPS and temporal ones, which take longer than rendering."""
    lpips_weights: Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")] = None
    """Folder or file with the networks' weights for LPIPS. Default: $STRUCTGSTREAM_LPIPS_WEIGHTS, torch's hub cache."""
    device: Device = "auto"
    """Back-end that renders."""


def main(arguments: list[str]) -> None:
    """Evaluates and prints a table."""
    options = parse_options(Evaluate, "evaluate", arguments=arguments)
    check_ending(options.json, ".json", command="evaluate", option="--json")
    check_ending(options.report, command="evaluate", option="--report", folder=True)
    from structgstream.codec.reader import open_stream
    from structgstream.evaluation.recording import capture_of, stored_capture
    from structgstream.evaluation.report import as_json
    from structgstream.kernels.backend import select_backend

    reader = open_stream(options.stream)
    source = capture_of(reader.header, options.scene, frames=len(reader.packets))
    report = run_evaluation(
        reader,
        source,
        stream=options.stream,
        backend=select_backend(options.device),
        cameras=options.cameras,
        folder=options.report,
        metrics=options.metrics,
        lpips_weights=options.lpips_weights,
        stored=stored_capture(reader.header, options.scene, frames=len(reader.packets)),
    )
    console = write_json_output(options.json, as_json(report))
    console.print(report_tables(report, title=options.stream.name))
    if options.report is not None:
        print_lines(console, f"Report: {options.report}")


def run_evaluation(
    reader: "StreamReader",
    source: "FrameSource",
    *,
    stream: Path,
    backend: "Backend",
    cameras: tuple[str, ...] | None,
    folder: Path | None,
    metrics: "MetricSelection" = "all",
    lpips_weights: Path | None = None,
    stored: "FrameSource | None" = None,
) -> "Report":
    """Evaluates with a progress display, and writes the report into ``folder`` (None: nowhere)."""
    from structgstream.evaluation.evaluate import Compared, evaluate
    from structgstream.evaluation.pictures import contact_sheet, spread_indices
    from structgstream.evaluation.plots import write_plots
    from structgstream.evaluation.report import as_json, write_json
    from structgstream.evaluation.run_log import read_log
    from structgstream.evaluation.worst import WorstPictures, write_page

    frames = len(reader.packets)
    wanted = set(spread_indices(frames, SHEET_COLUMNS)) if frames else set()
    compared_pictures: dict[str, dict] = {}
    worst = WorstPictures()
    console = Console(stderr=True)
    with console.status("evaluating") as status:

        def observe(index: int, compared: Compared) -> None:
            status.update(f"evaluating frame {index + 1} of {frames}")
            if folder is not None:
                worst.see(index, compared)
                if index in wanted:
                    compared_pictures.setdefault(compared.camera, {})[index] = (compared.truth, compared.picture)

        report = evaluate(
            reader,
            source,
            backend=backend,
            cameras=cameras,
            log=read_log(stream),
            observer=observe,
            metrics=metrics,
            lpips_weights=lpips_weights,
            stored=stored,
        )
    if folder is not None:
        title = f"{source.name}, {stream.name}: {quality_text(report)} over {frames} frames"
        write_json(folder / "report.json", as_json(report))
        write_plots(folder / "over_time.png", report, title=title)
        contact_sheet(folder / "contact_sheet.png", compared_pictures, title=title)
        write_page(folder, worst.crops(), title=title, pictures=("over_time.png", "contact_sheet.png"))
    return report
