# SPDX-License-Identifier: Apache-2.0
"""What a stream file holds, as tables for a terminal."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.table import Table

from structgstream.cli.progress import change, human_bytes
from structgstream.cli.tables import SHOWN_FRAMES, compact_table, literal_cells, name_value_table

if TYPE_CHECKING:
    from structgstream.evaluation.byte_count import Row

SMALL_BYTES = 100_000  # if all packets are smaller, sizes are printed in bytes
SHORT = {"anchor_positions": "positions", "covariance_mlp": "cov. mlp", "the rest": "rest"}  # 80 characters a line


def facts_table(header: Mapping[str, Any], rows: "Sequence[Row]", *, packets: Sequence[Mapping[str, Any]]) -> Table:
    """Facts of the stream: source, length, size, rate, added and removed items, whether it is complete."""
    cameras = header["cameras"]
    held_out = [name for name, camera in cameras.items() if camera["held_out"]]
    sizes = sorted({f"{camera['width']}x{camera['height']}" for camera in cameras.values()})
    table = name_value_table()
    for name, value in header["metadata"].items():
        table.add_row(*literal_cells(name, str(value)))
    table.add_row("codec", header["codec"])
    table.add_row("frames", f"{len(rows)} at {header['fps']:g} a second, {len(rows) / header['fps']:.2f} s")
    table.add_row(
        *literal_cells("cameras", f"{len(cameras)} of {', '.join(sizes)}; held out: {', '.join(held_out) or 'none'}")
    )
    headers = "header" if len(header["periods"]) < 2 else f"{len(header['periods'])} headers"
    table.add_row("size", f"{human_bytes(header['total_bytes'])}, {headers} {human_bytes(header['header_bytes'])}")
    if rows:
        table.add_row("rate", bit_rate_text(rows, header["fps"]))
    table.add_row("dynamic", ", ".join(header["dynamic"]) or "-")
    changes = [packet["changes"] for packet in packets if packet["changes"]]
    if changes:
        grown, removed, spawned, pruned = (
            sum(one.get(name, 0) for one in changes) for name in ("grown", "removed", "spawned", "pruned")
        )
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
    mean = sum(row.bytes for row in rows) / len(rows)
    return f"{8e-6 * mean * fps:.2f} Mbit/s without the header"


def period_table(periods: Sequence[Mapping[str, Any]]) -> Table | None:
    """A row per period; None for a stream of one."""
    if len(periods) < 2:
        return None
    table = compact_table()
    table.title = "periods"
    for name in ("period", "frame", "frames", "seconds", "anchors", "header", "packets"):
        table.add_column(name, justify="right")
    table.add_column("begins")
    for one in periods:
        anchors = one["fields"]["anchor_positions"]["shape"][0] if "anchor_positions" in one["fields"] else ""
        table.add_row(
            str(one["period"]),
            str(one["first_frame"]),
            str(one["frames"]),
            f"{one['seconds']:.2f}",
            f"{anchors:,}" if anchors != "" else "-",
            human_bytes(one["header_bytes"]),
            human_bytes(one["packet_bytes"]),
            *literal_cells(one["begins"] or "-"),
        )
    return table


def header_table(header: Mapping[str, Any]) -> Table:
    """The fields of an init record, largest first."""
    table = compact_table()
    table.title = f"header of period {header['period']}" if header["period"] else "header"
    table.add_column("field")
    for name in ("shape", "bytes", "share", "bits a value"):
        table.add_column(name, justify="right")
    whole = header["header_bytes"]
    rest = whole
    for name, field in sorted(header["fields"].items(), key=lambda item: -item[1]["bytes"]):
        size, values = field["bytes"], math.prod(field["shape"])
        shape = " x ".join(f"{length}" for length in field["shape"])
        bits = f"{8 * size / values:.2f}" if values else "-"
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

    lines = [[str(row.index), row.kind, *cells(row.bytes, row.sizes)] for row in rows[::step]]
    groups = groups_of(rows)
    means = [
        ["mean", name.split()[0], *cells(groups[name].bytes, groups[name].sizes)] for name in groups if name != FIRST
    ]
    table = compact_table()
    table.padding = 0
    table.title = "packets, bytes" if small else "packets, kB"
    if step > 1:
        table.title += f"; 1 in {step} is listed (--all-packets: every one)"
    titles = [SHORT.get(name, name.replace("_", " ")) for name in names]
    for title in ("frame", "kind", "all", *titles):
        # One word per line, so that titles do not break inside words.
        table.add_column(title.replace(" ", "\n"), justify="left" if title == "kind" else "right", no_wrap=True)
    for line in lines:
        table.add_row(*line)
    table.add_section()
    for line in means:
        table.add_row(*line)
    return table
