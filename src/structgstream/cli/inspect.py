# SPDX-License-Identifier: Apache-2.0
"""``structgstream inspect``."""

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console
from rich.table import Table

from structgstream.cli.options import JsonPath, StreamFile, parsed
from structgstream.cli.progress import human_bytes
from structgstream.cli.tables import SHOWN_FRAMES, columns, grid, plain

if TYPE_CHECKING:
    from structgstream.codec.reader import StreamReader


@dataclass(frozen=True)
class Inspect:
    """Shows what a stream file holds: header, packets, bytes by field, whether it is whole.

    Example: structgstream inspect ball.sgs --json ball-inspect.json
    """

    stream: tyro.conf.Positional[StreamFile]
    """The stream file."""
    json: JsonPath = None
    """Write all of it to this file, with the keys "header" and "packets"."""
    config: bool = False
    """Print the resolved configuration of the run."""


def main(arguments: list[str]) -> None:
    """Reads the file and prints."""
    options = parsed(Inspect, "inspect", arguments=arguments)
    from structgstream.codec.reader import open_stream
    from structgstream.evaluation.report import write_json

    content = described(open_stream(options.stream))
    if options.json is not None:
        write_json(options.json, content)
    console = Console()
    header = content["header"]
    if options.config:
        console.print_json(json.dumps(header["config"]))
        return
    console.print(_facts(content))
    console.print()
    console.print(_packets(content["packets"]))


def described(reader: "StreamReader") -> dict[str, Any]:
    """The file as plain values: ``header`` and ``packets`` (``kind``, ``index``, ``bytes``, ``fields``,
    ...).
    """
    from structgstream.codec.packets import PacketKind

    header = reader.header
    cameras = {
        name: {
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "viewmat": camera.viewmat.tolist(),
            "near": camera.near,
            "held_out": name in header.rig.held_out,
        }
        for name, camera in header.rig.cameras.items()
    }
    fields = {
        name: {"shape": list(tensor.shape), "bytes": reader.header_field_bytes[name]}
        for part in (header.static, header.reference)
        for name, tensor in part.items()
    }
    packets = [
        {
            "kind": PacketKind(info.kind).name.lower(),
            "index": info.index,
            "pts_seconds": info.pts_seconds,
            "offset": info.offset,
            "bytes": info.bytes,
            "fields": dict(info.field_bytes),
        }
        for info in reader.packets
    ]
    return {
        "header": {
            "codec": header.codec,
            "fps": header.fps,
            "frames": len(packets),
            "complete": reader.complete,
            "cut_reason": reader.cut_reason,
            "header_bytes": reader.header_bytes,
            "total_bytes": reader.total_bytes,
            "similarity": {"center": list(header.similarity.center), "scale": header.similarity.scale},
            "dynamic": sorted(header.dynamic),
            "fields": fields,
            "distance_input": header.distance_input,
            "cameras": cameras,
            "config": dict(header.config),
            "metadata": dict(header.metadata),
        },
        "packets": packets,
    }


def _facts(content: dict[str, Any]) -> Table:
    header, packets = content["header"], content["packets"]
    cameras = header["cameras"]
    held_out = [name for name, camera in cameras.items() if camera["held_out"]]
    sizes = sorted({f"{camera['width']}x{camera['height']}" for camera in cameras.values()})
    seconds = len(packets) / header["fps"]
    table = grid()
    for name, value in header["metadata"].items():
        table.add_row(*plain(name, str(value)))
    table.add_row("codec", header["codec"])
    table.add_row("frames", f"{len(packets)} at {header['fps']:g} a second, {seconds:.2f} s")
    table.add_row(*plain("cameras", f"{len(cameras)} of {', '.join(sizes)}; held out: {', '.join(held_out) or 'none'}"))
    table.add_row("size", f"{human_bytes(header['total_bytes'])}, header {human_bytes(header['header_bytes'])}")
    fields = ", ".join(f"{name} {human_bytes(field['bytes'])}" for name, field in header["fields"].items())
    table.add_row("in the header", fields or "-")
    table.add_row("dynamic", ", ".join(header["dynamic"]))
    table.add_row("state", "complete" if header["complete"] else f"not finished: {header['cut_reason']}")
    return table


def _packets(packets: list[dict[str, Any]]) -> Table:
    table = columns()
    table.title = "packets, kB"
    names = sorted({name for packet in packets for name in packet["fields"]})
    table.add_column("packet", justify="right")
    table.add_column("kind")
    for name in ("seconds", "all", *(name.replace("_", " ") for name in names)):
        # Field names break between words, never inside one.
        table.add_column(name, justify="right", min_width=max(len(word) for word in name.split()))
    step = max(-(-len(packets) // SHOWN_FRAMES), 1)
    for packet in packets[::step]:
        sizes = [packet["bytes"], *(packet["fields"].get(name, 0) for name in names)]
        row = (str(packet["index"]), packet["kind"], f"{packet['pts_seconds']:.3f}")
        table.add_row(*row, *(f"{size / 1000:.1f}" for size in sizes))
    return table
