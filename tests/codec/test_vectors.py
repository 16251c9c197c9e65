# SPDX-License-Identifier: Apache-2.0
"""The golden streams of version 2: what a release has written must be readable for ever, and raw written the same.

What a ``compact`` encoder chooses may become better; what a decoder makes of it may not change.
"""

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import pytest
import zstandard

from structgstream.codec.container.records import scan_records
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.segments.manifest import manifest_from_json, manifest_to_json
from structgstream.codec.segments.stored_bytes import open_segments
from structgstream.scene.state import state_of
from tests.support.sounds import stream_heard
from tests.vectors.generate import (
    CLAP_SECONDS,
    COMPACT_EXPECTED,
    COMPACT_STREAM,
    EXPECTED,
    LATER,
    PERIODS_EXPECTED,
    PERIODS_STREAM,
    SEGMENTS,
    SOUND_EXPECTED,
    SOUND_STREAM,
    STREAM,
    SUMS,
    compact_stream,
    golden_header,
    golden_stream,
    plain_fields,
)


def canonical(data: bytes) -> tuple[bytes, bytes, list[tuple[int, bytes]], bytes]:
    """The stream with the description unpacked, since releases of zstd compress differently: prefix, text, records."""
    records = list(scan_records(data))
    init = records[0].payload
    (length,) = struct.unpack_from("<I", init)
    text = zstandard.ZstdDecompressor().decompress(init[4 : 4 + length])
    rest = [(record.type, record.payload) for record in records[1:-1]]
    return data[:12], text + init[4 + length :], rest, data[-8:]


def relative_index(data: bytes) -> list[tuple[int, int, int]]:
    """Entries of the index with offsets from the end of the init record, and the footer's last."""
    records = list(scan_records(data))
    entries = list(struct.iter_unpack("<IBQ", records[-1].payload))
    (footer,) = struct.unpack_from("<Q", data, len(data) - 16)
    return [(a, b, offset - records[0].end) for a, b, offset in [*entries, (0, 0, footer)]]


def test_the_files_are_those_that_were_published() -> None:
    for path in (STREAM, COMPACT_STREAM, PERIODS_STREAM, SOUND_STREAM):
        assert path.stat().st_size < 20_000, path
    lines = SUMS.read_text().splitlines()
    assert len(lines) == 8 + len(list(SEGMENTS.iterdir()))
    for line in lines:
        digest, name = line.split()
        assert hashlib.sha256((STREAM.parent / name).read_bytes()).hexdigest() == digest, name


def test_today_s_encoder_writes_the_golden_stream() -> None:
    golden, today = STREAM.read_bytes(), golden_stream()
    assert canonical(today) == canonical(golden)
    assert relative_index(today) == relative_index(golden)


@pytest.mark.parametrize(
    ("stream", "wanted", "count"),
    [
        (STREAM, EXPECTED, 3),
        (COMPACT_STREAM, COMPACT_EXPECTED, 6),
        (PERIODS_STREAM, PERIODS_EXPECTED, 8),
        (SOUND_STREAM, SOUND_EXPECTED, 12),
    ],
)
def test_today_s_decoder_reads_a_golden_stream(stream: Path, wanted: Path, count: int) -> None:
    reader = open_stream(stream)
    assert reader.complete
    check(reader, json.loads(wanted.read_text())["frames"], count)


def test_the_second_period_has_a_header_of_its_own() -> None:
    reader = open_stream(PERIODS_STREAM, by_index=True)
    assert [(one.number, one.first_frame) for one in reader.periods] == [(0, 0), (1, LATER)]
    notes = [reader.header_of(frame).metadata["note"] for frame in (LATER - 1, LATER)]
    assert notes == ["ä", "later"]
    assert "covariance_mlp" in reader.header.dynamic - reader.header_of(LATER).dynamic


def test_the_golden_sound_is_beside_its_frames() -> None:
    """A decoder makes a clap of it at half a second, in the white frame."""
    expected = json.loads(SOUND_EXPECTED.read_text())
    for by_index in (False, True):
        with open_stream(SOUND_STREAM, by_index=by_index) as reader:
            assert reader.header.sound.plain() == expected["sound"]
            for frame in expected["frames"]:
                sound = reader.sound(frame["index"])
                found = {"seconds": sound.seconds, "packets": [packet.hex() for packet in sound.packets]}
                assert found == frame["sound"]
            assert stream_heard(reader) == pytest.approx([CLAP_SECONDS], abs=1e-3)


def check(reader: StreamReader, frames: list[dict[str, Any]], count: int) -> None:
    """Forwards, and then every frame alone."""
    assert len(frames) == len(reader) == count
    backwards = [(reader.packets[i], reader.scene(i)) for i in reversed(range(count))]
    for found in (list(reader.scenes()), backwards[::-1]):
        for frame, (info, scene) in zip(frames, found, strict=True):
            got = (info.index, info.pts_seconds, info.kind.name)
            assert got == (frame["index"], frame["pts_seconds"], frame["kind"])
            assert plain_fields(scene) == frame["fields"]


def test_today_s_compact_encoder_says_the_same_in_not_more_bytes() -> None:
    today = compact_stream()
    check(StreamReader(today), json.loads(COMPACT_EXPECTED.read_text())["frames"], 6)
    assert len(today) <= COMPACT_STREAM.stat().st_size + 50, "zstd differs a little"


def test_today_s_reader_understands_the_golden_header() -> None:
    header, wanted = open_stream(STREAM).header, golden_header()
    assert (header.fps, header.similarity, header.dynamic) == (30.0, wanted.similarity, wanted.dynamic)
    assert (header.config, header.metadata) == (wanted.config, wanted.metadata)
    assert [*header.rig] == ["left", "middle", "right"]
    assert header.rig.held_out == {"middle"}
    assert header.rig["right"].viewmat[0].tolist() == [1.0, 0.0, 0.0, -1.0]
    assert header.rig["left"].K.flatten().tolist() == [40.0, 0, 24, 0, 40.25, 16, 0, 0, 1]


def test_the_golden_segments_are_the_beginning_of_the_golden_stream() -> None:
    """docs/segments.md: init record, segments, parts; version 1 of the manifest must be readable for ever."""
    with open_stream(SEGMENTS) as reader, open_stream(COMPACT_STREAM) as whole:
        assert [*reader.packets] == [*whole.packets]
        assert not reader.complete
        assert all(state_of(reader.scene(i)).keys() == state_of(whole.scene(i)).keys() for i in range(6))
    with open_segments(SEGMENTS) as stored:
        assert COMPACT_STREAM.read_bytes().startswith(stored[:])
    manifest = manifest_from_json((SEGMENTS / "manifest.json").read_bytes(), name="manifest.json")
    assert (len(manifest.segments), len(manifest.parts), manifest.live) == (1, 3, True)
    assert manifest_to_json(manifest) == (SEGMENTS / "manifest.json").read_bytes()
    named = {entry.file for entry in (*manifest.periods, *manifest.history, *manifest.segments, *manifest.parts)}
    assert named | {"manifest.json"} == {path.name for path in SEGMENTS.iterdir()}
