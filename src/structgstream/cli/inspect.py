# SPDX-License-Identifier: Apache-2.0
"""``structgstream inspect``."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from structgstream.cli.app import UsageError
from structgstream.cli.options import Flag, JsonPath, StreamFile, check_ending, parse_options, write_json_output
from structgstream.cli.progress import print_lines
from structgstream.cli.stream_tables import bit_rate_text, facts_table, header_table, packet_table, period_table

if TYPE_CHECKING:
    from structgstream.cameras import CameraRig
    from structgstream.codec.reader import StreamReader
    from structgstream.evaluation.byte_count import Row

CHANGES = ("grown", "removed", "spawned", "pruned")
MAX_PERIODS = 3
"""Tables of the fields of headers are printed for so many periods; ``--json`` has all."""
PICTURES = (".png", ".svg", ".pdf")


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
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PATH.png", help_behavior_hint="")] = None
    """Plot the bytes of every packet by field, and the composition of header, key and delta packets."""
    json: JsonPath = None
    """Write everything to this file, with the keys "header" and "packets"; - is standard
    output."""
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
    if options.stream.is_dir() and not (options.stream / "manifest.json").exists():
        _print_capture(options)
        return
    from structgstream.codec.reader import open_stream
    from structgstream.evaluation.byte_count import packet_rows
    from structgstream.evaluation.run_log import read_log

    with open_stream(options.stream) as reader:
        rows = packet_rows(reader)
        content = describe_stream(reader, rows, log=read_log(options.stream))
        console = write_json_output(options.json, content)
        if plot is not None:
            draw_byte_plot(plot, reader, rows, name=options.stream.name)
    if options.config:
        console.print_json(json.dumps(content["header"]["config"]))
        return
    packets = packet_table(rows, every=options.all_packets)
    for part in (
        facts_table(content["header"], rows, packets=content["packets"]),
        period_table(content["header"]["periods"]),
        *(header_table(period) for period in content["header"]["periods"][:MAX_PERIODS]),
        packets,
    ):
        if part is None:
            continue
        console.print(part)
        console.print()
    if plot is not None:
        print_lines(console, f"Wrote {plot}")


def _print_capture(options: Inspect) -> None:
    from structgstream.cli.capture_table import capture_tables, describe_capture

    if options.plot is not None or options.config or options.all_packets:
        raise UsageError("--plot, --config and --all-packets are of streams; of a capture only --json can be given.")
    content = describe_capture(options.stream)
    console = write_json_output(options.json, content)
    for table in capture_tables(options.stream.resolve().name, content):
        console.print(table)


def draw_byte_plot(path: Path, reader: "StreamReader", rows: "Sequence[Row]", *, name: str) -> None:
    """Writes the picture.

    Raises:
        UsageError: there is nothing to draw.
    """
    if not rows:
        raise UsageError("the stream has no whole frame, so there is nothing to draw.")
    from structgstream.evaluation.byte_count import parts_of
    from structgstream.evaluation.byte_plot import write_byte_plot

    frames = "1 frame" if len(rows) == 1 else f"{len(rows)} frames"
    write_byte_plot(
        path, rows, parts_of(reader, rows), title=f"{name}: {frames}, {bit_rate_text(rows, reader.header.fps)}"
    )


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
            "cameras": _cameras(header.rig),
            "config": dict(header.config),
            "metadata": dict(header.metadata),
        },
        "packets": [_packet(row, log.get(row.index, {})) for row in rows],
    }


def _cameras(rig: "CameraRig") -> dict[str, dict[str, Any]]:
    return {
        name: {
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "viewmat": camera.viewmat.tolist(),
            "near": camera.near,
            "held_out": name in rig.held_out,
        }
        for name, camera in rig.cameras.items()
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
        "seconds": within[-1].pts_seconds - within[0].pts_seconds + 1.0 / header.fps if within else 0.0,
        "header_bytes": before + period.bytes,
        "packet_bytes": sum(row.bytes for row in within),
        "begins": log.get(period.first_frame, {}).get("begins"),
        "fields": {
            name: {"shape": list(tensor.shape), "bytes": sizes[name]}
            for part in (header.static, header.reference)
            for name, tensor in part.items()
        },
    }
