# SPDX-License-Identifier: Apache-2.0
"""A bit that flipped on the disk is not a crash: continuing must not throw whole frames away."""

from pathlib import Path

import pytest

from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import FileSink
from structgstream.errors import StreamError
from tests.support.streams import small_stream


def test_frames_after_a_damaged_one_are_not_thrown_away(tmp_path: Path) -> None:
    data = bytearray(small_stream())
    packet = StreamReader(bytes(data)).packets[1]
    data[packet.offset + 20] ^= 1
    path = tmp_path / "damaged.sgs"
    path.write_bytes(data)
    with pytest.raises(StreamError, match="continuing would overwrite the whole frames"):
        FileSink.resume(path)
    assert path.read_bytes() == data


def test_damage_at_the_very_end_is_an_interrupted_write(tmp_path: Path) -> None:
    whole = small_stream()
    reader = StreamReader(whole)
    last = reader.packets[-1]
    data = bytearray(whole[: last.offset + last.bytes])
    data[-6] ^= 1
    path = tmp_path / "torn.sgs"
    path.write_bytes(data)
    sink, resumed = FileSink.resume(path)
    assert resumed is not None
    assert len(resumed) == len(reader) - 1
    sink.close()
