# SPDX-License-Identifier: Apache-2.0
"""``structgstream inspect``: what a stream file holds, or what was understood of a capture."""

import json
import logging
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.table import Table

from structgstream.cli.app import UsageError
from structgstream.cli.options import (
    Flag,
    JsonPath,
    StreamFile,
    check_ending,
    parse_options,
    shown_as,
    write_json_output,
)
from structgstream.cli.progress import (
    SHOWN_FRAMES,
    change,
    compact_table,
    frames_text,
    human_bytes,
    literal_cells,
    name_value_table,
    print_lines,
)

if TYPE_CHECKING:
    from structgstream.codec.reader import StreamReader
    from structgstream.data.source import FrameSource
    from structgstream.data.video_index import VideoTrack
    from structgstream.evaluation.byte_count import Row

CHANGES = ("grown", "removed", "spawned", "pruned")
MAX_PERIODS = 3
"""Tables of the fields of headers are printed for so many periods; ``--json`` has all."""
PICTURES = (".png", ".svg", ".pdf")
STREAM_FILES = ("manifest.json", "qualities.json")
"""A folder with one of these files is a stream; any other is a capture."""


@dataclass(frozen=True)
class Inspect:
    """Shows the content of a stream file: header and packets, bytes by field, whether it is complete.

    Of the folder of a capture: what was understood of it, before anything is trained.

    Example: structgstream inspect ball.sgs --plot ball-bytes.png

    Example: structgstream inspect ball.sgs --json ball-inspect.json

    Example: structgstream inspect captures/take1
    """

    stream: tyro.conf.Positional[StreamFile]
    """The stream file, or the folder of a capture."""
    plot: Annotated[Path | None, shown_as("PATH.png")] = None
    """Plot the bytes of every packet by field, and the composition of header, key and delta packets."""
    json: JsonPath = None
    """Write everything to this file; - is standard output. Keys of a stream: "header" and "packets"; of a capture:
    "layout", "fps", "frames", "held_out", "points", "cameras" and "remarks"."""
    all_packets: Flag = False
    """List every packet. Default: evenly spaced packets of a long stream."""
    config: Flag = False
    """Print the resolved configuration of the run."""


def main(arguments: list[str]) -> None:
    """Reads the file and prints."""
    options = parse_options(Inspect, "inspect", arguments=arguments)
    plot = options.plot
    check_ending(options.json, ".json", command="inspect", option="--json")
    if plot is not None and plot.suffix.lower() not in PICTURES:
        raise UsageError(f"{plot} is no name for a picture; its ending must be one of {', '.join(PICTURES)}.")
    if options.stream.is_dir() and not any((options.stream / name).exists() for name in STREAM_FILES):
        _print_capture(options)
        return
    from structgstream.codec.reader import open_stream
    from structgstream.evaluation.byte_count import packet_rows, parts_of, write_byte_plot
    from structgstream.evaluation.run_log import log_of

    with open_stream(options.stream) as reader:
        rows = packet_rows(reader)
        log = log_of(options.stream, {row.index: row.bytes for row in rows})
        content = describe_stream(reader, rows, log=log)
        console = write_json_output(options.json, content)
        if plot is not None:
            if not rows:
                raise UsageError("the stream has no whole frame, so there is nothing to draw.")
            title = f"{options.stream.name}: {frames_text(len(rows))}, {bit_rate_text(rows, reader.header.fps)}"
            write_byte_plot(plot, rows, parts_of(reader, rows), title=title)
    if options.config:
        console.print_json(json.dumps(content["header"]["config"]))
        return
    periods = content["header"]["periods"]
    for part in (
        facts_table(content["header"], rows, packets=content["packets"]),
        period_table(periods),
        *map(header_table, periods[:MAX_PERIODS]),
        packet_table(rows, every=options.all_packets),
    ):
        if part is not None:
            console.print(part)
            console.print()
    if plot is not None:
        print_lines(console, f"Wrote {plot}")


def _print_capture(options: Inspect) -> None:
    if options.plot is not None or options.config or options.all_packets:
        raise UsageError("--plot, --config and --all-packets are of streams; of a capture only --json can be given.")
    content = describe_capture(options.stream)
    console = write_json_output(options.json, content)
    for table in capture_tables(options.stream.resolve().name, content):
        console.print(table)


def describe_stream(
    reader: "StreamReader", rows: "Sequence[Row]", *, log: Mapping[int, Mapping[str, Any]]
) -> dict[str, Any]:
    """The file as plain values: ``header`` and ``packets`` (``kind``, ``index``, ``bytes``, ``fields``, ...).

    ``changes`` of a packet are the numbers of added and removed anchors and free Gaussians, if the run's ``log`` has
    them.
    """
    header = reader.header
    periods = [describe_period(reader, place, rows, log=log) for place in range(len(reader.periods))]
    return {
        "header": {
            "codec": header.codec,
            "fps": header.fps,
            "frames": len(rows),
            "complete": reader.complete,
            "cut_reason": reader.cut_reason,
            "damage": [
                {"offset": one.offset, "first": one.frames.start, "end": one.frames.stop} for one in reader.damage
            ],
            "header_bytes": reader.header_bytes,
            "periods": periods,
            "total_bytes": reader.total_bytes,
            "similarity": {"center": list(header.similarity.center), "scale": header.similarity.scale},
            "dynamic": sorted(header.dynamic),
            "fields": periods[0]["fields"],
            "distance_input": header.distance_input,
            "cameras": header.rig.plain(),
            "config": dict(header.config),
            "metadata": dict(header.metadata),
            **({"sound": header.sound.plain()} if header.sound else {}),
        },
        "packets": [_packet(row, log.get(row.index, {})) for row in rows],
    }


def _packet(row: "Row", logged: Mapping[str, Any]) -> dict[str, Any]:
    from structgstream.evaluation.byte_count import REST

    return {
        "kind": row.kind,
        "index": row.index,
        "pts_seconds": row.pts_seconds,
        "offset": row.offset,
        "bytes": row.bytes,
        "fields": {name: size for name, size in row.sizes.items() if name != REST},
        "changes": {name: logged[name] for name in CHANGES if name in logged},
        "counts": logged.get("counts", {}),
    }


def describe_period(
    reader: "StreamReader", place: int, rows: "Sequence[Row]", *, log: Mapping[int, Mapping[str, Any]]
) -> dict[str, Any]:
    """A period as plain values: its frames, its header's fields, and why it begins, if the run's ``log`` says so."""
    from structgstream.evaluation.byte_count import shown_seconds

    begun = reader.periods
    period = begun[place]
    end = begun[place + 1].first_frame if place + 1 < len(begun) else len(reader.packets.offsets)
    header, sizes = reader.header_of(period.first_frame), reader.field_bytes_of(place)
    before = reader.header_bytes - sum(one.bytes for one in begun) if place == 0 else 0  # the file's prefix
    within = [row for row in rows if period.first_frame <= row.index < end]
    return {
        "period": period.number,
        "first_frame": period.first_frame,
        "frames": end - period.first_frame,
        "seconds": shown_seconds(within, header.fps),
        "header_bytes": before + period.bytes,
        "packet_bytes": sum(row.bytes for row in within),
        "begins": log.get(period.first_frame, {}).get("begins"),
        "fields": {
            name: {"shape": list(tensor.shape), "bytes": sizes[name]}
            for part in (header.static, header.reference)
            for name, tensor in part.items()
        },
    }


SMALL_BYTES = 100_000  # if all packets are smaller, sizes are printed in bytes
SHORT = {"anchor_positions": "positions", "covariance_mlp": "cov. mlp", "the rest": "rest"}  # 80 characters a line


def facts_table(header: Mapping[str, Any], rows: "Sequence[Row]", *, packets: Sequence[Mapping[str, Any]]) -> Table:
    """Facts of the stream: source, length, size, rate, added and removed items, whether it is complete."""
    from structgstream.evaluation.byte_count import shown_seconds

    cameras, seconds = header["cameras"], shown_seconds(rows, header["fps"])
    at = ", at most" if seconds * header["fps"] > len(rows) + 0.5 else " at"  # a live run leaves frames out
    held_out = [name for name, camera in cameras.items() if camera["held_out"]]
    sizes = sorted({f"{camera['width']}x{camera['height']}" for camera in cameras.values()})
    table = name_value_table()
    for name, value in header["metadata"].items():
        table.add_row(*literal_cells(name, str(value)))
    table.add_row("codec", header["codec"])
    table.add_row("frames", f"{len(rows)}{at} {header['fps']:g} a second, {seconds:.2f} s")
    table.add_row(
        *literal_cells("cameras", f"{len(cameras)} of {', '.join(sizes)}; held out: {', '.join(held_out) or 'none'}")
    )
    headers = "header" if len(header["periods"]) < 2 else f"{len(header['periods'])} headers"
    table.add_row("size", f"{human_bytes(header['total_bytes'])}, {headers} {human_bytes(header['header_bytes'])}")
    if sound := header.get("sound"):
        table.add_row("sound", f"{sound['codec']}, {sound['channels']} channel{'s' * (sound['channels'] > 1)}")
    if rows:
        table.add_row("rate", bit_rate_text(rows, header["fps"]))
    table.add_row("dynamic", ", ".join(header["dynamic"]) or "-")
    changes = [packet["changes"] for packet in packets if packet["changes"]]
    if changes:
        grown, removed, spawned, pruned = (sum(one.get(name, 0) for one in changes) for name in CHANGES)
        anchors, free = change(grown, removed) or " (none)", change(spawned, pruned) or " (none)"
        table.add_row("came, went", f"anchors{anchors}, free Gaussians{free}, says the log")
    acts = Counter[str]()
    for packet in packets:
        acts.update(packet["counts"])
    if acts:
        table.add_row("acts", ", ".join(f"{name} {count:,}" for name, count in acts.items()))
    state = "damaged" if header["damage"] else "not finished"
    table.add_row(
        "state",
        "complete: its run ended or was stopped in order" if header["complete"] else f"{state}: {header['cut_reason']}",
    )
    return table


def bit_rate_text(rows: "Sequence[Row]", fps: float) -> str:
    """The mean rate of at least one packet, as text."""
    from structgstream.evaluation.byte_count import shown_seconds

    megabits = 8e-6 * sum(row.bytes for row in rows)
    return f"{megabits / shown_seconds(rows, fps):.2f} Mbit/s without the header"


def period_table(periods: Sequence[Mapping[str, Any]]) -> Table | None:
    """A row per period; None for a stream of one."""
    if len(periods) < 2:
        return None
    titles = ("period", "frame", "frames", "seconds", "anchors", "header", "packets", "begins")
    table = compact_table(*titles, left=("begins",), title="periods")
    for one in periods:
        positions = one["fields"].get("anchor_positions")
        table.add_row(
            str(one["period"]),
            str(one["first_frame"]),
            str(one["frames"]),
            f"{one['seconds']:.2f}",
            f"{positions['shape'][0]:,}" if positions else "-",
            human_bytes(one["header_bytes"]),
            human_bytes(one["packet_bytes"]),
            *literal_cells(one["begins"] or "-"),
        )
    return table


def header_table(header: Mapping[str, Any]) -> Table:
    """The fields of an init record, largest first."""
    title = f"header of period {header['period']}" if header["period"] else "header"
    table = compact_table("field", "shape", "bytes", "share", "bits a value", left=("field",), title=title)
    rest = whole = header["header_bytes"]
    for name, field in sorted(header["fields"].items(), key=lambda item: -item[1]["bytes"]):
        size, values = field["bytes"], math.prod(field["shape"])
        shape, bits = " x ".join(map(str, field["shape"])), f"{8 * size / values:.2f}" if values else "-"
        table.add_row(name.replace("_", " "), shape, f"{size:,}", f"{size / whole:.1%}", bits)
        rest -= size
    table.add_row("the rest", "", f"{rest:,}", f"{rest / whole:.1%}", "")
    return table


def packet_table(rows: "Sequence[Row]", *, every: bool) -> Table:
    """A row per packet, or for :data:`SHOWN_FRAMES` of them, and the means below; largest field first."""
    from structgstream.evaluation.byte_count import FIRST, groups_of, occurring_fields

    names = occurring_fields(row.sizes for row in rows)
    small = max((row.bytes for row in rows), default=0) < SMALL_BYTES
    step = 1 if every else max(-(-len(rows) // SHOWN_FRAMES), 1)

    def cells(whole: float, sizes: Mapping[str, float]) -> list[str]:
        numbers = [whole, *(sizes.get(name, 0) for name in names)]
        return [f"{number:,.0f}" if small else f"{number / 1000:,.1f}" for number in numbers]

    table = compact_table()
    table.padding = 0
    table.title = "packets, bytes" if small else "packets, kB"
    if step > 1:
        table.title += f"; 1 in {step} is listed (--all-packets: every one)"
    titles = [SHORT.get(name, name.replace("_", " ")) for name in names]
    for title in ("frame", "kind", "all", *titles):
        # One word per line, so that titles do not break inside words.
        table.add_column(title.replace(" ", "\n"), justify="left" if title == "kind" else "right", no_wrap=True)
    for row in rows[::step]:
        table.add_row(str(row.index), row.kind, *cells(row.bytes, row.sizes))
    table.add_section()
    for name, sizes in groups_of(rows).items():
        if name != FIRST:
            table.add_row("mean", name.split()[0], *cells(sum(sizes.values()), sizes))
    return table


def describe_capture(path: Path) -> dict[str, Any]:
    """The capture at ``path`` as plain values: ``layout``, ``fps``, ``frames``, ``held_out``, ``points``, ``cameras``
    and ``remarks``.

    ``remarks`` are the warnings of its reader: what is left out, and why. A folder without calibration is described as
    the footage that ``prepare`` would read.
    """
    from structgstream.data.open import Uncalibrated, layout_of, open_capture
    from structgstream.preparation.footage import NoFootage

    with _warnings() as remarks:
        try:
            source = open_capture(path)
        except Uncalibrated as error:
            try:
                return _describe_footage(path, remarks)
            except NoFootage:
                raise error from None
        cameras = {name: _camera(source, name) for name in source.rig}
    return {
        "layout": layout_of(path),
        "fps": source.fps,
        "frames": len(source),
        "held_out": sorted(source.rig.held_out),
        "points": None if source.points is None else len(source.points),
        "cameras": cameras,
        "remarks": remarks,
    }


def _describe_footage(path: Path, remarks: list[str]) -> dict[str, Any]:
    from structgstream.preparation.footage import find_footage

    footage = find_footage(path)
    cameras: dict[str, Any] = {}
    for name in footage.cameras:
        stamps, track = footage.stamps(name), footage.tracks.get(name)
        cameras[name] = {"size": footage.size(name), "lens": "-", "frames": len(stamps)}
        cameras[name] |= {"first_seconds": float(stamps[0]), "last_seconds": float(stamps[-1])}
        cameras[name] |= {"colors": "-", "turned": "no"} if track is None else _of_track(track)
    remark = f"There is no calibration: structgstream prepare {path} -o CAPTURE makes a capture of these files."
    return {
        "layout": "videos or pictures without calibration",
        "fps": footage.fps,
        "frames": min(camera["frames"] for camera in cameras.values()),
        "held_out": [],
        "points": None,
        "cameras": cameras,
        "remarks": [*remarks, remark],
    }


def capture_tables(name: str, content: dict[str, Any]) -> tuple[Table, ...]:
    """The facts, a row per camera, and the remarks."""
    facts = name_value_table()
    facts.add_row(*literal_cells("capture", name))
    facts.add_row(*literal_cells("layout", content["layout"]))
    seconds = content["frames"] / content["fps"]
    facts.add_row("frames", f"{content['frames']} at {content['fps']:g} a second, {seconds:.2f} s")
    facts.add_row(*literal_cells("held out", ", ".join(content["held_out"]) or "none"))
    colors = {own["colors"] for own in content["cameras"].values()}
    if len(colors) == 1:
        facts.add_row(*literal_cells("colours", *colors))
    facts.add_row("points", "none" if content["points"] is None else f"{content['points']:,}")
    titles = ["camera", "size", "lens", "frames", "from s", "to s", "turned", *["colours"] * (len(colors) > 1)]
    cameras = compact_table(*titles, left=("camera", "lens", "colours"), title="cameras")
    for camera, own in content["cameras"].items():
        times = ["-" if own[key] is None else f"{own[key]:.3f}" for key in ("first_seconds", "last_seconds")]
        size = "x".join(map(str, own["size"]))
        cells = (camera, size, own["lens"], str(own["frames"]), *times, own["turned"])
        cameras.add_row(*literal_cells(*cells, *([own["colors"]] if len(colors) > 1 else [])))
    remarks = name_value_table()
    for remark in content["remarks"]:
        remarks.add_row(*literal_cells("note", remark))
    return facts, cameras, remarks


def _camera(source: "FrameSource", name: str) -> dict[str, Any]:
    from structgstream.data.images import ImageSource
    from structgstream.data.source import SourceWrapper
    from structgstream.data.undistortion import UndistortedSource
    from structgstream.data.video import VideoSource

    lens, stored = "pinhole", source
    while isinstance(stored, SourceWrapper):
        if isinstance(stored, UndistortedSource):
            lens = type(stored.filmed[name].lens).__name__
        stored = stored.source
    camera = stored.rig[name]
    found: dict[str, Any] = {"size": (camera.width, camera.height), "lens": lens, "frames": len(stored)}
    found |= {"first_seconds": None, "last_seconds": None, "colors": "-", "turned": "no"}
    if isinstance(stored, VideoSource):
        track, stamps = stored.tracks[name], [stamp for stamp in stored.stamps[name] if stamp is not None]
        times = [(stamp - track.origin) * track.tick_seconds for stamp in (stamps[0], stamps[-1])]
        found |= {"frames": len(stamps), "first_seconds": times[0], "last_seconds": times[1], **_of_track(track)}
    elif isinstance(stored, ImageSource):
        places = [place for place, file in enumerate(stored.files[name]) if file is not None]
        first, last = places[0], places[-1]
        found |= {"frames": len(places), "first_seconds": first / stored.fps, "last_seconds": last / stored.fps}
        found["colors"] = next(file.suffix for file in stored.files[name] if file is not None)
        turn = stored.turns.get(name, 1)
        found["turned"] = "no" if turn == 1 else f"EXIF {turn}"
    return found


def _of_track(track: "VideoTrack") -> dict[str, str]:
    return {"colors": track.colors, "turned": f"{90 * track.quarter_turns} degrees" if track.quarter_turns else "no"}


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Warnings of the readers, as text, which are not printed meanwhile."""
    found: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(record.getMessage())

    handler, logger = Collector(logging.WARNING), logging.getLogger("structgstream")
    propagates, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield found
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagates
