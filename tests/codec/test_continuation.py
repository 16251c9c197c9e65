# SPDX-License-Identifier: Apache-2.0
"""Where a stream file that was cut can be continued."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.records import PREFIX, RECORD, prefix, read_record
from structgstream.codec.contents import readable_part
from structgstream.codec.reader import StreamReader
from structgstream.errors import StreamError
from tests.support.properties import examples
from tests.support.streams import small_stream

WHOLE = small_stream()
with StreamReader(WHOLE) as _reader:
    ENDS = [_reader.packets.at(i).offset + _reader.packets.at(i).bytes for i in range(len(_reader))]


def init_end() -> int:
    record = read_record(WHOLE, PREFIX.size)
    assert record is not None
    return record.end


@given(st.integers(0, len(WHOLE)))
@examples(300)
def test_a_stream_cut_anywhere_goes_on_after_its_last_whole_packet(cut: int) -> None:
    whole = [end for end in (init_end(), *ENDS) if end <= cut]
    assert readable_part(WHOLE[:cut], name="it") == (max(whole) if whole else None)


def test_a_finished_stream_goes_on_before_its_index() -> None:
    assert readable_part(WHOLE, name="it") == ENDS[-1] < len(WHOLE)


@given(st.integers(PREFIX.size, ENDS[-2] - 1), st.integers(0, 7))
@examples(400)
def test_a_bit_that_flipped_never_costs_whole_frames(byte: int, bit: int) -> None:
    """Whatever it is in, the init record, a length, or a packet before the last: nothing after it is given up."""
    data = bytearray(WHOLE)
    data[byte] ^= 1 << bit
    with pytest.raises(StreamError, match="^Cannot continue it: .* Keep a copy"):
        readable_part(bytes(data), name="it")


@pytest.mark.parametrize("power", range(32))
def test_a_flipped_bit_in_the_length_of_the_init_record_is_no_cut(power: int) -> None:
    """The record then seems to be longer than the file, as that of a writer that was killed at its start."""
    data = bytearray(WHOLE)
    length = struct.unpack_from("<I", data, PREFIX.size + RECORD.size - 4)[0]
    struct.pack_into("<I", data, PREFIX.size + RECORD.size - 4, length ^ 1 << power)
    with pytest.raises(StreamError, match="Cannot continue it"):
        readable_part(bytes(data), name="it")


def test_damage_at_the_end_is_a_write_that_was_interrupted() -> None:
    data = bytearray(WHOLE[: ENDS[-1]])
    data[-1] ^= 1
    assert readable_part(bytes(data), name="it") == ENDS[-2]


@pytest.mark.parametrize("data", [b"", prefix()[:3], prefix()])
def test_what_was_hardly_begun_begins_again(data: bytes) -> None:
    assert readable_part(data, name="it") is None


@pytest.mark.parametrize("data", [b"Dear", b"\x89SGX" + bytes(20), WHOLE[1:]])
def test_what_is_no_stream_is_not_overwritten(data: bytes) -> None:
    with pytest.raises(StreamError, match="it is not a structgstream file"):
        readable_part(data, name="it")
