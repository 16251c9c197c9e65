# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

from structgstream.codec.packets import Packet, PacketKind, PacketSink
from structgstream.codec.sinks import FileSink, MemorySink


def test_both_sinks_take_packets(tmp_path: Path) -> None:
    sinks: list[PacketSink] = [MemorySink(), FileSink(tmp_path / "a.sgs")]
    for sink in sinks:
        sink.close()  # Nothing was opened, nothing happens.
    assert not (tmp_path / "a.sgs").exists()


def test_a_packet_is_shown_in_one_short_line() -> None:
    assert repr(Packet(PacketKind.DELTA, 3, 0.1, bytes(1000), {})) == "Packet(DELTA, index=3, 1000 bytes)"
