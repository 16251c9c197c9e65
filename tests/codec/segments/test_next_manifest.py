# SPDX-License-Identifier: Apache-2.0
"""From one manifest to the next."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.records import FRAME, RecordType, packed
from structgstream.codec.segments.manifest import Edge, PeriodEntry, Window, manifest_from_json, manifest_to_json
from structgstream.codec.segments.recovery import (
    Draft,
    empty_manifest,
    next_segment,
    part_of,
    periods_in,
    reopened,
    with_frame,
    with_segment,
)
from structgstream.errors import StreamError
from tests.support.properties import examples
from tests.support.segment_streams import folder, header

PERIOD = PeriodEntry(0, "init-0000-0123456789abcdef.sgs", 10, "0" * 64, 0, 0)


def begun() -> Draft:
    return Draft(empty_manifest(header(), PERIOD))


def grown(draft: Draft, *, key: bool = False) -> Draft:
    """With the next frame, and the group before it as a segment when it is a key frame."""
    frame = draft.manifest.edge.frame + 1
    data = packed(RecordType.KEY if key else RecordType.DELTA, FRAME.pack(frame, frame / 30.0) + bytes([frame % 256]))
    edge = Edge(frame, frame / 30.0, None, 1.7e9 + frame)
    return with_frame(with_segment(draft) if key else draft, part_of(data), data, edge)


def written(path: Path, draft: Draft) -> None:
    for name, content in draft.files:
        folder(path).put(name, content)


def test_before_the_first_frame() -> None:
    manifest = begun().manifest
    assert (manifest.edge.frame, manifest.live, manifest.fps, manifest.name) == (-1, True, 30.0, "test")
    assert (manifest.periods, manifest.segments, manifest.parts) == ((PERIOD,), (), ())
    assert next_segment(manifest) == 0
    assert with_segment(begun()) == begun()


def test_a_long_or_unreadable_name_of_a_capture_can_be_read_again() -> None:
    """A folder's name may hold bytes that are no text."""
    odd = replace(header(), metadata={"capture": "\udcff" + "x" * 2000})
    draft = grown(Draft(empty_manifest(odd, PERIOD)), key=True)
    assert manifest_from_json(manifest_to_json(draft.manifest), name="it").name == "?" + "x" * 999
    assert empty_manifest(replace(header(), metadata={}), PERIOD, sequence=7).sequence == 7


@given(st.lists(st.integers(1, 4), min_size=1, max_size=60))
@examples(60)
def test_groups_become_segments_without_gaps(groups: list[int]) -> None:
    """Every manifest is one that a reader takes, and the files are those of its new segment and pages."""
    draft, frame, files = begun(), 0, set()
    for number, size in enumerate(groups):
        for i in range(size):
            draft = grown(draft, key=i == 0)
            manifest = manifest_from_json(manifest_to_json(draft.manifest), name="it")
            assert manifest == draft.manifest
            assert (manifest.edge.frame, len(manifest.parts), next_segment(manifest)) == (frame, i + 1, number)
            assert len(draft.records) == i + 1
            frame += 1
        files |= {name for name, _ in draft.files}
    draft = with_segment(draft)
    files |= {name for name, _ in draft.files}
    assert {entry.file for entry in (*draft.manifest.history, *draft.manifest.segments)} <= files
    assert draft.manifest.periods == (PERIOD,)
    assert (draft.manifest.parts, draft.records, next_segment(draft.manifest)) == ((), (), len(groups))


def test_a_segment_that_was_closed_early_is_opened_again(tmp_path: Path) -> None:
    before = grown(grown(grown(grown(begun(), key=True), key=True)))
    stopped = with_segment(before)
    written(tmp_path, stopped)
    again = reopened(replace(stopped, files=()), folder(tmp_path))
    assert again.manifest == before.manifest
    assert again.records == before.records
    assert [name for name, _ in again.files] == [part.file for part in before.manifest.parts]
    assert [content for _, content in again.files] == list(before.records)
    on, straight = with_segment(grown(again)), with_segment(grown(before))
    assert on.manifest == straight.manifest


def test_a_damaged_segment_is_not_opened_again(tmp_path: Path) -> None:
    stopped = with_segment(grown(begun(), key=True))
    name, content = stopped.files[-1]
    folder(tmp_path).put(name, content[:-1] + b"x")
    with pytest.raises(StreamError, match=name):
        reopened(stopped, folder(tmp_path))


def test_periods_of_which_something_is_in_the_window() -> None:
    periods = [replace(PERIOD, period=i, first_frame=10 * i) for i in range(4)]

    def kept(first_frame: int) -> list[int]:
        return [one.period for one in periods_in(periods, Window(first_frame, 0, 5.0))]

    assert kept(0) == kept(9) == [0, 1, 2, 3]
    assert kept(10) == kept(19) == [1, 2, 3]
    assert kept(30) == kept(1000) == [3]
    assert periods_in([replace(PERIOD, first_frame=5)], Window(0, 0, None)) == (replace(PERIOD, first_frame=5),)
