# SPDX-License-Identifier: Apache-2.0
"""Streams of several periods that several tests look at: the scenes of each have a size of their own."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

from structgstream.codec.packets import Packet, PacketKind, PacketSink, StreamHeader
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import MemorySink
from structgstream.scene.scene import Scene
from tests.support.streams import compact_header, header_for, moved, small_scene

LENGTHS = (4, 5, 3)
"""Frames of each period; key packets are every second frame, and where a period begins."""
FRAMES = sum(LENGTHS)
FIRSTS = (0, 4, 9)
KEYS = frozenset({0, 2, 4, 6, 8, 9, 11})


def period_header(period: int, *, codec: str = "compact") -> StreamHeader:
    """The header of a period; the scenes of period p have 3 + p anchors."""
    scene = small_scene(3 + period, seed=period)
    header = compact_header(scene) if codec == "compact" else header_for(scene)
    return replace(header, periods=True)


def period_of(frame: int) -> int:
    """The period of a frame."""
    return sum(first <= frame for first in FIRSTS) - 1


@cache
def period_packets(*, codec: str = "compact") -> tuple[list[StreamHeader], list[Packet], list[Scene]]:
    """The headers of the periods, all packets, and the scenes that a reader must see."""
    headers = [period_header(period, codec=codec) for period in range(len(LENGTHS))]
    packets, seen = [], []
    for period, length in enumerate(LENGTHS):
        encoder, first = SceneEncoder(headers[period]), small_scene(3 + period, seed=period)
        for index in range(FIRSTS[period], FIRSTS[period] + length):
            kind = PacketKind.KEY if index in KEYS else PacketKind.DELTA
            encoded = encoder.encode(moved(first, index), index=index, pts_seconds=index / 30.0, kind=kind)
            packets.append(encoded.packet)
            seen.append(encoded.reconstruction)
    return headers, packets, seen


def write_packets(
    sink: PacketSink, headers: Sequence[StreamHeader], packets: Sequence[Packet], *, start: int = 0
) -> None:
    """Write these packets from frame ``start`` on, as a session does, and close."""
    sink.open(headers[period_of(max(start - 1, 0))])
    for packet in packets[start:]:
        if packet.index and packet.index in FIRSTS:
            sink.begin(headers[FIRSTS.index(packet.index)])
        sink.write(packet)
    sink.close()


@cache
def period_stream(*, codec: str = "compact") -> tuple[bytes, list[Scene]]:
    """A whole stream of three periods, and its scenes."""
    sink = MemorySink()
    headers, packets, seen = period_packets(codec=codec)
    write_packets(sink, headers, packets)
    return sink.data, seen
