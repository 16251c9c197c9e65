# SPDX-License-Identifier: Apache-2.0
"""Segments of a few kilobytes that nothing was fitted for."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from structgstream.codec.container.records import PREFIX, read_record
from structgstream.codec.packets import Packet, PacketKind, parse_packet, unpack_header
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.groups.base import GroupBase
from structgstream.groups.segment_file import SegmentIdentity, SegmentSink
from structgstream.scene.scene import Scene
from tests.support.streams import header_for, moved, small_scene, small_stream

FIRST, END = 3, 7
IDENTITY = SegmentIdentity("header", "capture", "track", {"iterations": 6, "births": 50}, FIRST, END)
FROM_FRAME_0 = replace(IDENTITY, track="", first=0, end=FIRST)


@cache
def base() -> GroupBase:
    """Frame 0 of a small stream."""
    data = small_stream(1)
    init = read_record(data, PREFIX.size)
    assert init is not None
    first = read_record(data, init.end)
    assert first is not None
    packet = parse_packet(first.payload, PacketKind.KEY)
    head, record = data[: init.end], data[init.end : first.end]
    return GroupBase("header.sgs", unpack_header(init.payload), head, record, packet)


@cache
def encoded(first: int = FIRST, end: int = END) -> tuple[list[Packet], list[Scene]]:
    """Packets of a group, the third of which is another key packet, and what a reader sees."""
    start = small_scene()
    encoder, packets, seen = SceneEncoder(header_for(start)), [], []
    for index in range(first, end):
        kind = PacketKind.DELTA if (index - first) % 2 else PacketKind.KEY
        found = encoder.encode(moved(start, index), index=index, pts_seconds=index / 30.0, kind=kind)
        packets.append(found.packet)
        seen.append(found.reconstruction)
    return packets, seen


def write(path: Path, packets: Sequence[Packet], *, identity: SegmentIdentity = IDENTITY) -> Path:
    """A segment with these packets, finished if they are all."""
    sink = SegmentSink(path, base(), identity, None)
    for packet in packets:
        sink.write(packet)
    sink.close()
    return path
