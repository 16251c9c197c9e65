# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest
from benchmarks.stream_entropy import counted_parts, told

from streams import compact_header, moved, small_scene, write_stream
from structgstream.codec.coder import Decoder
from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink


@pytest.fixture
def stream(tmp_path: Path) -> str:
    path = tmp_path / "a.sgs"
    first = small_scene(200)
    write_stream(FileSink(path), [moved(first, i) for i in range(4)], header=compact_header(first))
    return str(path)


def test_sections_are_counted_in_every_part(stream: str) -> None:
    section = Decoder._section
    parts = [*counted_parts(stream)]
    assert Decoder._section is section
    reader = open_stream(stream)
    assert [kind for kind, _ in parts] == [None, PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA, PacketKind.KEY]
    for info, (_, part) in zip(reader.packets, parts[1:], strict=True):
        assert 50 < part.bytes < info.bytes
        # Every name comes once in a packet.
        assert part.alone_bytes == pytest.approx(part.entropy_bytes())
        assert part.alone_bytes < part.bytes
    assert 1000 < parts[0][1].bytes < reader.header_bytes


def test_what_is_told(stream: str) -> None:
    lines = told(stream).splitlines()
    assert lines[0] == stream
    assert [line.partition(":")[0] for line in lines[1:]] == [
        "  init record, each section alone",
        "  packets, each section alone",
        "  packets, with the rest of their group",
    ]
    assert all(line.endswith(" % over") for line in lines[1:])
