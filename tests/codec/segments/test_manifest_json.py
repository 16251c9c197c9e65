# SPDX-License-Identifier: Apache-2.0
"""A manifest comes back as it was written, and what a hostile host sends is refused in words."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.packets import PacketKind
from structgstream.codec.segments.manifest import (
    MAX_MANIFEST_BYTES,
    Edge,
    Fields,
    HistoryEntry,
    Manifest,
    PartEntry,
    PeriodEntry,
    Window,
    file_name,
    manifest_from_json,
    manifest_to_json,
    page_from_json,
    page_to_json,
    sha256_of,
)
from structgstream.errors import StreamError
from tests.support.segment_streams import SHA256, segment_entry

VECTORS = Path(__file__).parents[2] / "vectors"
GOLDEN = (VECTORS / "segments-1" / "manifest.json").read_bytes()
RULES: list[dict[str, Any]] = json.loads((VECTORS / "manifest-rules.json").read_text())


def manifest() -> Manifest:
    """One page of two segments, two segments, two parts."""
    page = page_to_json([segment_entry(0), segment_entry(1)])
    name = file_name("history", 0, sha256_of(page))
    return Manifest(
        sequence=12,
        live=True,
        fps=30.0,
        name="studio, ä",
        target_latency_seconds=12.0,
        frame_seconds=None,
        edge=Edge(13, 13 / 30, None, 1.7e9 + 0.1),
        window=Window(0, 0, None),
        periods=(PeriodEntry(0, file_name("init", 0, SHA256), 812_345, SHA256, 0, 0),),
        history=(HistoryEntry(name, 0, 0, 2, 0, 6, (0.0, 5 / 30), len(page), sha256_of(page)),),
        segments=(segment_entry(2), segment_entry(3)),
        parts=(
            PartEntry(file_name("part", 12, SHA256), 12, 0, PacketKind.KEY, 12 / 30, 90, SHA256),
            PartEntry(file_name("part", 13, SHA256), 13, 0, PacketKind.DELTA, 13 / 30, 9, SHA256),
        ),
    )


def read(data: bytes) -> Manifest:
    return manifest_from_json(data, name="manifest.json")


def changed(data: bytes, path: Sequence[Any], value: Any) -> Any:
    """JSON with another value at a place."""
    plain = place = json.loads(data)
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return plain


def test_a_manifest_comes_back_and_equal_ones_are_equal_bytes() -> None:
    data = manifest_to_json(manifest())
    assert read(data) == manifest()
    assert manifest_to_json(read(data)) == data
    plain = json.loads(data)
    assert (plain["format"], plain["version"], plain["parts"][1]["kind"]) == ("structgstream-segments", 1, "delta")
    assert data.startswith(b'{"edge":')


def test_pages_come_back_and_pages_of_pages() -> None:
    first, second = [segment_entry(0), segment_entry(1)], [segment_entry(2)]
    pages = [
        HistoryEntry("h.json", 0, 0, 2, 0, 6, (0.0, 5 / 30), 1, SHA256),
        HistoryEntry("h.json", 0, 2, 1, 6, 3, (6 / 30, 8 / 30), 1, SHA256),
    ]
    for entries, page in zip((first, second), pages):
        assert page_from_json(page_to_json(entries), page) == tuple(entries)
    data = page_to_json(pages)
    above = HistoryEntry("hh.json", 1, 0, 3, 0, 9, (0.0, 8 / 30), len(data), SHA256)
    assert page_from_json(data, above) == tuple(pages)
    with pytest.raises(StreamError, match="hh.json has 3 segments of 9 frames; expected 4 of 9"):
        page_from_json(data, replace(above, segments=4))
    with pytest.raises(StreamError, match="other levels than 1"):
        page_from_json(data, replace(above, level=2))
    with pytest.raises(StreamError, match="has no 'segments'"):
        page_from_json(data, replace(above, level=0))
    with pytest.raises(StreamError, match="begins with frame 0 and segment 0, where frame 3 and segment 1 belong"):
        page_from_json(page_to_json(first), replace(pages[0], first_segment=1, first_frame=3))


BAD: list[tuple[tuple[Any, ...], Any, str]] = [
    (("format",), "mp4", "is no manifest of segments: its format is 'mp4'"),
    (("version",), 2, "has version 2; this program reads 1"),
    (("sequence",), -1, "'sequence' -1; expected a whole number"),
    (("live",), 1, "'live' 1; expected true or false"),
    (("edge", "frame"), 14, "lists frames 0 to 13, and its edge is frame 14"),
    (("window", "first_frame"), 14, "window that begins after its edge"),
    (("window", "first_segment"), 5, "window that begins after its edge"),
    (("window",), [], r"window is \[\]; expected an object"),
    (("periods",), [], "names no init record of the first frame of its window"),
    (("periods", 0, "file"), "../init.sgs", "expected the plain name of a file beside it"),
    (("periods", 0, "sha256"), "00", "expected 64 hex digits"),
    (("segments", 0, "frames"), 10**9, "whole number from 1 to 65536"),
    (("segments", 0, "bytes"), 2**60, "expected a whole number"),
    (("segments", 0, "bytes"), 121, "lengths of frames that are not those of the segment"),
    (("segments", 0, "key_bytes"), 99, "lengths of frames that are not those of the segment"),
    (("segments", 0, "frame_bytes"), [1, 2], "expected a list of 3 whole numbers"),
    (("segments", 0, "first_frame"), 7, "begins with frame 7 and segment 2, where frame 6 and segment 2 belong"),
    (("segments", 1, "segment"), 2, "where frame 9 and segment 3 belong"),
    (("segments", 0, "pts_seconds"), [1.0], "two numbers"),
    (("segments", 0, "pts_seconds"), [1.0, 0.5], "two numbers that do not fall"),
    (("segments", 0, "period"), 1, "names no init record of period 1"),
    (("segments",), {}, "expected a list of at most 4096 objects"),
    (("parts", 1, "frame"), 15, "has a part of frame 15 where one of frame 13 belongs"),
    (("parts", 0, "kind"), "index", "'kind' 'index'; expected key or delta"),
    (("history", 0, "level"), 9, "from 0 to 8"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "message"), BAD, ids=[f"{path}={str(v)[:12]}" for path, v, _ in BAD])
def test_what_contradicts_the_format_is_refused_in_words(path: tuple[Any, ...], value: Any, message: str) -> None:
    with pytest.raises(StreamError, match=message):
        read(json.dumps(changed(manifest_to_json(manifest()), path, value)).encode())


@pytest.mark.parametrize(
    "name", ["", ".a", "..", "a/b", "a\\b", "a b", "a\n", "A" * 129, "é", "http:x", "%2e", None, 1, ["a"]]
)
def test_names_that_lead_elsewhere(name: object) -> None:
    with pytest.raises(StreamError, match="plain name of a file"):
        Fields({"file": name}, "it").file()


@pytest.mark.parametrize("digest", ["0" * 63, "0" * 65, "A" * 64, "g" * 64, "0" * 63 + "\n", None, 0])
def test_what_is_no_hash(digest: object) -> None:
    with pytest.raises(StreamError, match="64 hex digits"):
        Fields({"sha256": digest}, "it").sha256()
    assert Fields({"sha256": "0f" * 32}, "it").sha256() == "0f" * 32


def test_a_manifest_that_has_ended_has_no_parts_and_what_is_missing_is_named() -> None:
    plain = json.loads(manifest_to_json(manifest()))
    with pytest.raises(StreamError, match="has parts although its run has ended"):
        read(json.dumps(plain | {"live": False}).encode())
    for name in plain:
        with pytest.raises(StreamError, match=f"has no '{name}'"):
            read(json.dumps({key: value for key, value in plain.items() if key != name}).encode())
    assert read(json.dumps(plain | {"later": [1, {"unknown": None}]}).encode()) == manifest()


@pytest.mark.parametrize("rule", RULES, ids=[f"{rule['at']} {rule['json'][:24]}" for rule in RULES])
def test_the_rules_that_the_player_follows_too(rule: dict[str, Any]) -> None:
    """viewer/packages/player/test/manifest.test.ts reads the same cases."""
    plain = changed(GOLDEN, rule["at"], "@")
    value = re.sub(r"<(.+?)\*(\d+)>", lambda found: found[1] * int(found[2]), rule["json"])
    data = json.dumps(plain).replace('"@"', value).encode()
    if rule["taken"]:
        read(data)
    else:
        with pytest.raises(StreamError, match=r"^manifest.json"):
            read(data)


def test_a_byte_order_mark_and_what_is_too_long_are_refused() -> None:
    read(GOLDEN)
    with pytest.raises(StreamError, match="is not JSON"):
        read(b"\xef\xbb\xbf" + GOLDEN)
    read(GOLDEN + b" " * (MAX_MANIFEST_BYTES - len(GOLDEN)))
    with pytest.raises(StreamError, match="expected at most 4194304"):
        read(GOLDEN + b" " * (MAX_MANIFEST_BYTES + 1 - len(GOLDEN)))


@given(st.data())
def test_no_changed_byte_does_more_than_raise_our_error(data: st.DataObject) -> None:
    whole = bytearray(manifest_to_json(manifest()))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(whole) - 1))
        whole[place] = data.draw(st.integers(0, 255))
    try:
        found = read(bytes(whole))
    except StreamError:
        return
    named = (*found.periods, *found.history, *found.segments, *found.parts)
    assert all("/" not in entry.file for entry in named)
