# SPDX-License-Identifier: Apache-2.0
"""A stream's bytes by packet, field, kind of packet and header, and a plot of them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import StreamReader
from structgstream.figure import COLORS, INK, OTHER, figure_of, save_figure, without_frame

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

REST = "the rest"
"""Bytes that belong to no field: heads of records, checksums, and the header's JSON."""
FIRST = "first packet"
NOTHING = 0.01  # share of the header's size; a smaller first packet is left out of the parts
Parts = dict[str, dict[str, float]]
"""Bytes by field, including :data:`REST`, of named parts of a stream."""


@dataclass(frozen=True)
class Row:
    """One packet: ``kind`` is ``key`` or ``delta``; ``sizes`` are bytes by field and sum, with the rest, to its size.

    ``first`` is True if it begins a period.
    """

    index: int
    kind: str
    pts_seconds: float
    offset: int
    bytes: int
    sizes: Mapping[str, int]
    first: bool = False


def packet_rows(reader: StreamReader) -> list[Row]:
    """The packet of every frame that can be decoded."""
    firsts = {period.first_frame for period in reader.periods}
    infos = (reader.packets.at(index) for run in reader.runs for index in run)
    return [
        Row(
            info.index,
            PacketKind(info.kind).name.lower(),
            info.pts_seconds,
            info.offset,
            info.bytes,
            with_rest(info.field_bytes, info.bytes),
            first=info.index in firsts,
        )
        for info in infos
    ]


def shown_seconds(frames: Sequence[PacketInfo | Row], fps: float) -> float:
    """Seconds for which a stream of ``fps`` shows these frames: the difference of the last and the first presentation
    time, which includes frames that a live run left out, plus one frame interval; 0 without frames."""
    return frames[-1].pts_seconds - frames[0].pts_seconds + 1.0 / fps if frames else 0.0


def with_rest(sizes: Mapping[str, int], whole: int) -> dict[str, int]:
    """Bytes by field, with the remainder of ``whole`` as :data:`REST`."""
    return {**sizes, REST: whole - sum(sizes.values())}


def occurring_fields(sizes: Iterable[Mapping[str, float]]) -> list[str]:
    """The fields that occur, largest sum first, :data:`REST` last."""
    sums: dict[str, float] = {}
    for one in sizes:
        for name, size in one.items():
            sums[name] = sums.get(name, 0) + size
    return sorted(sums, key=lambda name: (name == REST, -sums[name]))


def groups_of(rows: Sequence[Row]) -> Parts:
    """Mean bytes by field of the first packet of each period, and of each kind of the others.

    First packets are a group of their own: with the codec ``compact`` they are nearly empty, because headers contain
    their frames.
    """
    chosen = {
        FIRST: [row for row in rows if row.first],
        "key packets": [row for row in rows if row.kind == "key" and not row.first],
        "delta packets": [row for row in rows if row.kind == "delta"],
    }
    return {
        group: {
            name: sum(row.sizes.get(name, 0) for row in some) / len(some)
            for name in occurring_fields(row.sizes for row in some)
        }
        for group, some in chosen.items()
        if some
    }


def parts_of(reader: StreamReader, rows: Sequence[Row]) -> Parts:
    """Bytes by field of the headers, and of :func:`groups_of`; a nearly empty first packet is left out."""
    groups = groups_of(rows)
    if sum(groups.get(FIRST, {}).values()) <= NOTHING * reader.header_bytes:
        groups.pop(FIRST, None)
    return {"header": dict(with_rest(reader.header_field_bytes, reader.header_bytes)), **groups}


SMALL = 0.01  # fields below this share of every part are combined
TALLEST_KEY = 3.0  # times the largest delta packet; a larger key packet is drawn cut, with its size above it
MAX_GAPS = 150  # bars of more packets than this touch
MAX_SIZE_LABELS = 25  # sizes are not written for more cut packets than this
LABELLED_SHARE = 0.06  # smaller shares of a part are not labelled


def write_byte_plot(path: Path, rows: Sequence[Row], parts: Parts, *, title: str) -> None:
    """Draws a bar for each frame (at least one), stacked by field, and below them the composition of each of ``parts``.
    Fields have the order of :func:`field_colors`, which begins with the last part. Raises MissingExtraError without
    matplotlib, StorageError if the picture cannot be written."""
    colours = field_colors(parts)
    across = 0.34 * len(parts) + 0.3
    figure = figure_of(10.0, 4.4 + across)
    from matplotlib.patches import Patch  # figure_of has checked that it is installed

    top, bottom = figure.subplots(2, 1, height_ratios=(3.6, across))
    keys = _packets(top, rows, colours)
    top.set_title(title, fontsize=11, fontweight="bold", color=INK, loc="left", pad=10)
    _shares(bottom, parts, colours)
    fields = [Patch(color=colour, label=field.replace("_", " ")) for field, colour in colours.items()]
    figure.legend(handles=[*fields, keys], fontsize=8, frameon=False, loc="outside right upper")
    save_figure(figure, path)


def field_colors(parts: Parts) -> dict[str, str]:
    """A colour for each field above :data:`SMALL`, assigned from the last part to the first, by size in each part."""
    colours: dict[str, str] = {}
    for sizes in reversed(parts.values()):
        whole = sum(sizes.values())
        for field, size in sorted(sizes.items(), key=lambda item: -item[1]):
            if field != REST and size >= SMALL * whole and field not in colours and len(colours) < len(COLORS):
                colours[field] = COLORS[len(colours)]
    return {**colours, REST: OTHER}


def _packets(axis: "Axes", rows: Sequence[Row], colours: Mapping[str, str]) -> "Artist":
    """Draws the packets; returns the mark of key packets, for a legend."""
    index = np.array([row.index for row in rows])
    total = np.array([row.bytes for row in rows]) / 1000
    key = np.array([row.kind == "key" for row in rows])
    top = float(total.max())
    if key.any() and not key.all() and top > TALLEST_KEY * total[~key].max():
        top = 1.3 * float(total[~key].max())
    cut = total > top
    shown = np.minimum(total, top)
    base: NDArray[np.float64] = np.zeros(len(rows))
    for field, colour in colours.items():
        share = np.array([row.sizes.get(field, 0) / row.bytes for row in rows])
        height = shown - base if field == REST else shown * share
        if len(rows) <= MAX_GAPS:
            axis.bar(index, height, bottom=base, width=0.85, color=colour)
        else:  # One outline for all: thousands of bars would take minutes.
            edges = np.append(index, index[-1] + 1) - 0.5
            axis.stairs(base + height, edges, baseline=base, fill=True, facecolor=colour, edgecolor=colour, lw=0.3)
        base = base + height
    axis.hlines([0.93 * top] * int(cut.sum()), index[cut] - 0.6, index[cut] + 0.6, color="white", linewidth=2.5)
    for number, size in zip(index[cut], total[cut]):
        if cut.sum() <= MAX_SIZE_LABELS:
            axis.annotate(
                f"{size:,.0f}", (number, 1.04 * top), xytext=(6, 0), textcoords="offset points",
                fontsize=8, color=INK, va="center",
            )  # fmt: skip
    (keys,) = axis.plot(
        index[key], shown[key] + 0.04 * top, "v", color=INK, markersize=5.5,
        label="key packet, cut (kB)" if cut.any() else "key packet",
    )  # fmt: skip
    axis.set_ylim(0, 1.1 * top)
    axis.set_xlim(index[0] - 0.7, index[-1] + 0.7)
    axis.locator_params(axis="x", integer=True)
    axis.set_ylabel("kB a packet", fontsize=9)
    axis.set_xlabel("frame", fontsize=9)
    without_frame(axis)
    return keys


def _shares(axis: "Axes", parts: Parts, colours: Mapping[str, str]) -> None:
    """A horizontal bar for each part, all of equal length."""
    for row, sizes in enumerate(parts.values()):
        whole, base = sum(sizes.values()), 0.0
        for field, colour in colours.items():
            share = 1.0 - base if field == REST else sizes.get(field, 0.0) / whole
            axis.barh(row, share, left=base, height=0.72, color=colour)
            if share >= LABELLED_SHARE:
                ink = INK if _bright(colour) else "white"
                axis.text(base + share / 2, row, f"{share:.0%}", fontsize=8, color=ink, ha="center", va="center")
            base += share
    labels = [f"{name}\n{sum(sizes.values()) / 1000:,.1f} kB" for name, sizes in parts.items()]
    axis.set_yticks(range(len(parts)), labels)
    axis.invert_yaxis()
    axis.set_xlim(0, 1)
    axis.set_xticks([])
    axis.spines[:].set_visible(False)
    axis.tick_params(labelsize=8, length=0)


def _bright(colour: str) -> bool:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return 0.299 * red + 0.587 * green + 0.114 * blue > 140
