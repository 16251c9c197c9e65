# SPDX-License-Identifier: Apache-2.0
"""``structgstream evaluate``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from structgstream.cli.app import usage_errors
from structgstream.cli.options import (
    Cameras,
    Device,
    Folder,
    JsonPath,
    StreamFile,
    check_ending,
    parse_options,
    shown_as,
    write_json_output,
)
from structgstream.cli.progress import (
    SHOWN_FRAMES,
    compact_table,
    human_bytes,
    literal_cells,
    name_value_table,
    print_lines,
)

if TYPE_CHECKING:
    from structgstream.codec.reader import StreamReader
    from structgstream.data.source import FrameSource
    from structgstream.evaluation.optional_metrics import MetricSelection
    from structgstream.evaluation.report import Report, Scores
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
    cameras: Cameras = None
    """Cameras to score. Default: the held-out ones."""
    json: JsonPath = None
    """Write every number to this file, - is standard output (keys: docs/evaluation.md)."""
    report: Annotated[Path | None, shown_as("FOLDER")] = None
    """Write report.json and a page of the worst frames, plots over time and a contact sheet into this folder."""
    metrics: Literal["all", "basic"] = "all"
    """Metrics: "basic" leaves out MS-SSIM, FLIP, LPIPS and temporal ones, which take longer than rendering."""
    lpips_weights: Annotated[Path | None, shown_as("PATH")] = None
    """Folder or file with the networks' weights for LPIPS. Default: $STRUCTGSTREAM_LPIPS_WEIGHTS, torch's hub cache."""
    device: Device = "auto"
    """Back-end that renders."""


def main(arguments: list[str]) -> None:
    """Evaluates and prints a table."""
    options = parse_options(Evaluate, "evaluate", arguments=arguments)
    check_ending(options.json, ".json", command="evaluate", option="--json")
    check_ending(options.report, command="evaluate", option="--report", folder=True)
    from structgstream.codec.reader import open_stream
    from structgstream.evaluation.recording import captures_of, check_has_first_frame
    from structgstream.evaluation.report import as_json
    from structgstream.kernels.backend import select_backend

    reader = open_stream(options.stream)
    with usage_errors():
        check_has_first_frame(reader)
    source, stored = captures_of(reader.header, options.scene, frames=len(reader.packets))
    report = run_evaluation(
        reader,
        source,
        stream=options.stream,
        backend=select_backend(options.device),
        cameras=options.cameras,
        folder=options.report,
        metrics=options.metrics,
        lpips_weights=options.lpips_weights,
        stored=stored,
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
    from structgstream.evaluation.run_log import log_of
    from structgstream.evaluation.worst import WorstPictures, write_page

    frames = len(reader.packets)
    wanted = set(spread_indices(frames, SHEET_COLUMNS))
    compared_pictures: dict[str, dict] = {}
    worst = WorstPictures()
    console = Console(stderr=True)
    with console.status("evaluating") as status:

        def observe(index: int, compared: Compared) -> None:
            status.update(f"evaluating frame {index + 1} of {frames}")
            if folder is not None:
                worst.see(index, compared)
                # The first of each camera, too, which may be absent from all wanted ones.
                if index in wanted or compared.camera not in compared_pictures:
                    compared_pictures.setdefault(compared.camera, {})[index] = (compared.truth, compared.picture)

        report = evaluate(
            reader,
            source,
            backend=backend,
            cameras=cameras,
            log=log_of(stream, {info.index: info.bytes for info in reader.packets}),
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


Columns = Sequence[tuple[str, str, int, int]]
"""Title, key, factor and digits of scores."""

BASIC: Columns = (  # colour is PSNR after frame 0's colour fit
    ("PSNR", "psnr", 1, 2),
    ("colour", "psnr_camera_color", 1, 2),
    ("SSIM", "ssim", 1, 4),
    ("changed", "psnr_changed", 1, 2),
    ("still", "psnr_still", 1, 2),
)
FURTHER: Columns = (
    ("MS-SSIM", "ms_ssim", 1, 4),
    ("FLIP", "flip", 1, 4),
    ("LPIPS", "lpips_alex", 1, 4),
    ("VGG", "lpips_vgg", 1, 4),
    ("E_warp", "e_warp", 1, 5),
    ("tFLIP", "temporal_flip", 1, 4),
    ("tLPIPS", "t_lpips", 1, 5),
    ("flicker", "flicker", 1, 2),
    ("truth", "truth_flicker", 1, 2),
)
AT_OTHER_SIZES: Columns = (
    ("half", "psnr_half", 1, 2),
    ("SSIM", "ssim_half", 1, 4),
    ("stored", "psnr_stored", 1, 2),
    ("SSIM", "ssim_stored", 1, 4),
    ("disoccluded %", "disoccluded_share", 100, 2),
    ("ghosts %", "ghost_share", 100, 2),
    ("dB there", "psnr_disoccluded", 1, 2),
)


def report_tables(report: "Report", *, title: str) -> Group:
    """Scores by frame and by camera, and the facts of the file."""
    known = [column for column in AT_OTHER_SIZES if getattr(report.mean, column[1]) is not None]
    parts = [_frames(report, title), _cameras(report), _by_camera(report, known)]
    if report.stream["metrics"] == "all":
        parts.append(_by_camera(report, FURTHER))
    if report.stream["not_available"]:
        parts.append(_not_available(report))
    parts.append(_facts(report))
    return Group(*(part for shown in parts for part in (shown, Text())))


def _frames(report: "Report", title: str) -> Table:
    table = compact_table()
    table.title = Text(title)
    for name in ("frame", *(title for title, *_ in BASIC), "bytes", "anchors", "free", "seconds"):
        table.add_column(name, justify="right", no_wrap=True)
    frames = report.frames
    step = -(-len(frames) // SHOWN_FRAMES)
    for frame in frames[::step] if (len(frames) - 1) % step == 0 else [*frames[::step], frames[-1]]:
        seconds = frame.log.get("total_seconds")
        table.add_row(
            str(frame.index),
            *_cells(frame.mean, BASIC),
            human_bytes(frame.bytes),
            f"{frame.anchors:,}",
            f"{frame.free:,}",
            "-" if seconds is None else f"{seconds:.1f}",
        )
    table.add_section()
    mean_bytes = sum(frame.bytes for frame in frames) / len(frames)
    table.add_row("mean", *_cells(report.mean, BASIC), human_bytes(mean_bytes), "", "", "", style="bold")
    return table


def _cameras(report: "Report") -> Table:
    columns = (*BASIC, ("affine", "psnr_affine", 1, 2))
    table = compact_table("camera", "", *(title for title, *_ in columns), left=("camera", ""))
    for name, scores in report.cameras.items():
        table.add_row(*literal_cells(name, report.stream["cameras"][name]), *_cells(scores, columns))
    return table


def _by_camera(report: "Report", columns: Columns) -> Table:
    """The scores of ``columns`` by camera, and their mean."""
    table = compact_table("camera", *(title for title, *_ in columns), left=("camera",))
    for name, scores in (*report.cameras.items(), ("mean", report.mean)):
        table.add_row(*literal_cells(name), *_cells(scores, columns))
    return table


def _not_available(report: "Report") -> Table:
    """Which scores are missing, and why: one row for each reason."""
    reasons: dict[str, list[str]] = {}
    for name, reason in report.stream["not_available"].items():
        reasons.setdefault(reason, []).append(name)
    table = name_value_table()
    for reason, names in reasons.items():
        table.add_row("not available", Text(f"{', '.join(names)}: {reason}", overflow="fold"))
    return table


def _facts(report: "Report") -> Table:
    s = report.stream
    table = name_value_table()
    if s["absent_frames"]:
        counts = (f"{name} from {count} of {s['frames']} frames" for name, count in s["absent_frames"].items())
        table.add_row("absent", Text(f"{', '.join(counts)}; means are over the pictures that exist"))
    if s["masked_share"]:
        shares = (f"{name} {share:.1%}" for name, share in s["masked_share"].items())
        table.add_row("masked", Text(f"{', '.join(shares)} of the pixels, which are not scored"))
    equal = s["drift_at_equal_shares_db_per_frame"]
    at_equal_shares = "" if equal is None else f" ({equal:+.3f} if as many pixels had changed in all)"
    table.add_row(
        "PSNR over time",
        f"first {s['psnr_first']:.2f}, last {s['psnr_last']:.2f}, worst {s['psnr_worst']:.2f} dB; "
        f"drift {s['drift_db_per_frame']:+.3f} dB a frame{at_equal_shares}",
    )
    if found := s["worst"]["changed"]:
        table.add_row(
            "worst frame",
            Text(f"{found['frame']} of {found['camera']}: {found['psnr_changed']:.2f} dB on changed pixels"),
        )
    if found := s["worst"]["ghosts"]:
        pixels = 100 * found["ghost_share"] * found["disoccluded_share"]
        table.add_row(
            "most ghosts",
            Text(
                f"frame {found['frame']} of {found['camera']}: {100 * found['ghost_share']:.1f} % of the disoccluded "
                f"pixels, {pixels:.2f} % of all"
            ),
        )
    table.add_row(
        "size",
        f"{human_bytes(s['total_bytes'])}: header {human_bytes(s['header_bytes'])}, "
        f"{s['frames']} packets {human_bytes(s['packet_bytes'])}; "
        f"a frame {human_bytes(s['packet_bytes'] / s['frames'])}, {human_bytes(s['total_bytes'] / s['frames'])} with "
        "the header shared over them",
    )
    table.add_row(
        "rate",
        f"{s['megabits_per_second']:.2f} Mbit/s at {s['fps']:g} frames a second, "
        f"{s['megabits_per_second_with_header']:.2f} with the header",
    )
    fields = sorted(s["field_bytes"].items(), key=lambda item: -item[1])
    table.add_row("bytes by field", ", ".join(f"{name} {human_bytes(size)}" for name, size in fields if size))
    if "peak_memory_bytes" in s:
        memory = human_bytes(s["peak_memory_bytes"]) if s["peak_memory_bytes"] else "-"
        first = "-" if s["seconds_first"] is None else f"{s['seconds_first']:.1f} s"
        online = "-" if s["seconds_online_mean"] is None else f"{s['seconds_online_mean']:.2f} s"
        table.add_row("training", f"first frame {first}, each further one {online}, peak memory {memory}")
        if stages := s["peak_memory_bytes_by_stage"]:
            table.add_row("memory by stage", "; ".join(f"{name} {human_bytes(size)}" for name, size in stages.items()))
    table.add_row(
        "rendering",
        f"{s['render_fps']:.1f} pictures a second, {s['decode_and_render_fps']:.1f} with the decoding of the frame",
    )
    e = report.environment
    machine = f"{e['gpu'] or e['cpu']}, {e['cores']} cores, back-end {e['backend']}, torch {e['torch']}"
    table.add_row("machine", Text(machine))
    if e["peak_memory_bytes"]:
        table.add_row("this evaluation", f"peak memory {human_bytes(e['peak_memory_bytes'])}")
    return table


def _cells(scores: "Scores | None", columns: Columns) -> list[str]:
    """The scores of ``columns``; None where every scored camera is absent."""
    values = [(scores and getattr(scores, key), factor, digits) for _, key, factor, digits in columns]
    return ["-" if value is None else f"{factor * value:.{digits}f}" for value, factor, digits in values]


def quality_text(report: "Report") -> str:
    """The mean PSNR as text, with that after frame 0's colour fit."""
    color_fitted = report.mean.psnr_camera_color
    corrected = "" if color_fitted is None else f" ({color_fitted:.2f} after frame 0's colour fit)"
    return f"{report.mean.psnr:.2f} dB{corrected}"
