# SPDX-License-Identifier: Apache-2.0
"""The golden stream of format version 1: what was written once must be readable, and written the same, for ever."""

import hashlib
import json
import struct

import zstandard

from structgstream.codec.reader import open_stream
from structgstream.codec.records import scanned
from structgstream.scene.state import state_of
from vectors.generate import EXPECTED, STREAM, SUMS, golden_header, golden_stream


def canonical(data: bytes) -> tuple[bytes, bytes, list[tuple[int, bytes]], bytes]:
    """The stream with the description unpacked, since releases of zstd compress differently: prefix, text, records."""
    records = list(scanned(data))
    init = records[0].payload
    (length,) = struct.unpack_from("<I", init)
    text = zstandard.ZstdDecompressor().decompress(init[4 : 4 + length])
    rest = [(record.type, record.payload) for record in records[1:-1]]
    return data[:12], text + init[4 + length :], rest, data[-8:]


def relative_index(data: bytes) -> list[tuple[int, int, int]]:
    """Entries of the index with offsets from the end of the init record, and the footer's last."""
    records = list(scanned(data))
    entries = list(struct.iter_unpack("<IBQ", records[-1].payload))
    (footer,) = struct.unpack_from("<Q", data, len(data) - 16)
    return [(a, b, offset - records[0].end) for a, b, offset in [*entries, (0, 0, footer)]]


def test_the_files_are_those_that_were_published() -> None:
    assert STREAM.stat().st_size < 20_000
    for line in SUMS.read_text().splitlines():
        digest, name = line.split()
        assert hashlib.sha256((STREAM.parent / name).read_bytes()).hexdigest() == digest, name


def test_today_s_encoder_writes_the_golden_stream() -> None:
    golden, today = STREAM.read_bytes(), golden_stream()
    assert canonical(today) == canonical(golden)
    assert relative_index(today) == relative_index(golden)


def test_today_s_decoder_reads_the_golden_stream() -> None:
    reader = open_stream(STREAM)
    assert reader.complete
    frames = json.loads(EXPECTED.read_text())["frames"]
    assert len(frames) == len(reader) == 3
    for frame, (info, scene) in zip(frames, reader.scenes(), strict=True):
        assert (info.index, info.pts_seconds, info.kind.name) == (frame["index"], frame["pts_seconds"], frame["kind"])
        found = {
            name: {"shape": list(value.shape), "values": value.flatten().tolist()}
            for name, value in state_of(scene).items()
        }
        assert found == frame["fields"]


def test_today_s_reader_understands_the_golden_header() -> None:
    header, wanted = open_stream(STREAM).header, golden_header()
    assert (header.fps, header.similarity, header.dynamic) == (30.0, wanted.similarity, wanted.dynamic)
    assert (header.config, header.metadata) == (wanted.config, wanted.metadata)
    assert [*header.rig] == ["left", "middle", "right"]
    assert header.rig.held_out == {"middle"}
    assert header.rig["right"].viewmat[0].tolist() == [1.0, 0.0, 0.0, -1.0]
    assert header.rig["left"].K.flatten().tolist() == [40.0, 0, 24, 0, 40.25, 16, 0, 0, 1]
