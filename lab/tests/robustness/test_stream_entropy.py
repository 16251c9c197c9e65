# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from lab.stream_entropy import counted_init, packet_bytes, reported
from structgstream.codec.entropy.adaptive import AdaptiveDecoder
from structgstream.codec.entropy.rans import SectionDecoder
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from tests.support.streams import compact_header, moved, small_scene, write_stream


@pytest.fixture
def stream(tmp_path: Path) -> str:
    path = tmp_path / "a.sgs"
    first = small_scene(200)
    write_stream(FileSink(path), [moved(first, i) for i in range(4)], header=compact_header(first))
    return str(path)


def test_sections_of_the_init_record_are_counted(stream: str) -> None:
    section = SectionDecoder._section
    found = counted_init(stream)
    assert SectionDecoder._section is section
    assert 1000 < found.bytes < open_stream(stream).header_bytes
    assert 0.5 * found.bytes < found.entropy_bytes < found.bytes


def test_bytes_of_packets_add_up(stream: str) -> None:
    looked_at = AdaptiveDecoder._check_coded
    found = packet_bytes(stream)
    assert AdaptiveDecoder._check_coded is looked_at
    packets = open_stream(stream).packets
    # Heads of the blocks are not in it.
    assert found.total() == sum(size - 8 for info in packets for size in info.field_bytes.values())
    assert found["anchor_positions.change"] > 100


def test_what_is_reported(stream: str) -> None:
    lines = reported(stream).splitlines()
    assert lines[0] == stream
    assert lines[1].startswith("  init record: ")
    assert lines[1].endswith(" % over")
    assert lines[-1].startswith("  packets together: ")
