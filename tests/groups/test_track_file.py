# SPDX-License-Identifier: Apache-2.0
"""The file of a tracking pass: its starts, its list of groups, and where groups begin."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.atomic_files import partial_path
from structgstream.codec.container.records import packed
from structgstream.errors import ConfigError, StreamError
from structgstream.groups.track_file import (
    PREFIX,
    SIGNATURE,
    TrackHead,
    TrackRecord,
    TrackStart,
    TrackWriter,
    check_length,
    equal_groups,
    groups_path,
    open_track,
    quiet_groups,
    read_groups,
    track_bytes,
    write_groups,
)
from tests.support.killed import folders_of_the_killed
from tests.support.properties import examples

HEAD = TrackHead("ab", "cd", 0.01, 500, 4, {"scale": 0.5})


def start(frame: int, *, rows: int = 7, seed: int = 0) -> TrackStart:
    random = np.random.default_rng(seed + frame)
    movers = np.sort(random.choice(500, rows, replace=False)).astype(np.int32)
    displacements, velocities = (random.integers(-(10**6), 10**6, (rows, 3), dtype=np.int32) for _ in range(2))
    return TrackStart(frame, movers, displacements, velocities, random.random(4).astype(np.float32))


def same(one: TrackStart, other: TrackStart) -> bool:
    arrays = ("primitives", "displacements", "velocities")
    return one.frame == other.frame and all(np.array_equal(getattr(one, a), getattr(other, a)) for a in arrays)


@given(st.integers(1, 2**31), st.integers(0, 40), st.integers(0, 1000))
def test_a_start_comes_back(frame: int, rows: int, seed: int) -> None:
    given_start = start(frame, rows=rows, seed=seed)
    found = TrackStart.unpacked(given_start.packed())
    assert same(found, given_start)
    assert np.abs(found.changed - given_start.changed).max() <= 1 / 65535
    assert found.packed() == given_start.packed(), "what is stored is stored again as it was"


def test_a_track_comes_back_and_may_be_read_while_it_grows(tmp_path: Path) -> None:
    path = tmp_path / "t"
    writer = TrackWriter(path, HEAD)
    writer.write(start(4))
    growing = open_track(path)
    assert (growing.starts, growing.groups) == ([4], None)
    assert same(growing.start(4), start(4))
    with pytest.raises(StreamError, match="no start at frame 8; it has 4"):
        growing.start(8)
    writer.write(start(8))
    writer.finish(12, [(0, 4), (4, 8), (8, 12)])
    found = open_track(path)
    assert (found.head, found.starts) == (HEAD, [4, 8])
    assert found.groups == [(0, 4), (4, 8), (8, 12)]
    assert not partial_path(path).exists()


def test_killed_at_any_step_what_was_written_is_read(tmp_path: Path) -> None:
    def act(folder: Path) -> None:
        writer = TrackWriter(folder / "t", HEAD)
        for frame in (4, 8):
            writer.write(start(frame))
        writer.finish(12, [(0, 12)])

    for folder in folders_of_the_killed(tmp_path, act, begin=lambda folder: None):
        try:
            found = open_track(folder / "t")
        except StreamError:
            assert not (folder / "t").exists()
            continue
        assert found.starts in ([], [4], [4, 8])
        assert (found.groups is not None) >= (folder / "t").exists()


def test_a_cut_or_damaged_track_says_so(tmp_path: Path) -> None:
    path = tmp_path / "t"
    writer = TrackWriter(path, HEAD)
    writer.write(start(4))
    writer.write(start(8))
    writer.finish(12, [(0, 12)])
    data = path.read_bytes()
    whole = open_track(path)
    ends = [end for _, end in whole.whole_starts()]
    for cut in (ends[0], ends[0] + 5, ends[1] - 1, ends[1], len(data) - 1):
        path.write_bytes(data[:cut])
        found = open_track(path)
        assert found.groups is None
        assert [s.frame for s, _ in found.whole_starts()] == [4, 8][: sum(cut >= end for end in ends)]
    flipped = bytearray(data)
    flipped[ends[1] - 9] ^= 1
    path.write_bytes(flipped)
    assert same(open_track(path).start(4), start(4))
    with pytest.raises(StreamError, match="start at frame 8 .* is damaged"):
        open_track(path).start(8)
    assert [s.frame for s, _ in open_track(path).whole_starts()] == [4]


def test_what_is_no_track_is_refused(tmp_path: Path) -> None:
    path, prefix = tmp_path / "t", PREFIX.pack(SIGNATURE, 1, 0)
    other = PREFIX.pack(SIGNATURE, 9, 0)
    for data, said in ((b"", "is no track"), (other, "version 9"), (prefix + b"xx", "is damaged")):
        path.write_bytes(data)
        with pytest.raises(StreamError, match=said):
            open_track(path)


@pytest.mark.parametrize("content", ["{}", '{"groups": 3}', '{"groups": [[0]]}', "[" * 9999])
def test_an_end_that_does_not_follow_the_format(tmp_path: Path, content: str) -> None:
    path = tmp_path / "t"
    path.write_bytes(track_bytes(HEAD, start(4)) + packed(TrackRecord.END, content.encode()))
    with pytest.raises(StreamError, match="The end of the track .* does not follow the format"):
        open_track(path)


@examples(60)
@given(st.lists(st.integers(1, 90), min_size=1, max_size=9), st.data())
def test_groups_come_back_and_those_that_do_not_follow_each_other_do_not(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int], choice: st.DataObject
) -> None:
    track = tmp_path_factory.mktemp("groups") / "track"
    borders = [0, *(sum(lengths[: i + 1]) for i in range(len(lengths)))]
    groups = [*pairwise(borders)]
    write_groups(track, groups)
    assert read_groups(track) == groups
    number = choice.draw(st.integers(0, len(groups) - 1))
    shift = choice.draw(st.integers(1, 5))
    first, end = groups[number]
    wrong = choice.draw(st.sampled_from([(first + shift, end), (first - shift, end), (first, first)]))
    groups[number] = wrong
    write_groups(track, groups)
    with pytest.raises(StreamError, match="do not follow each other from frame 0 on"):
        read_groups(track)


def test_undecided_groups_are_none(tmp_path: Path) -> None:
    assert read_groups(tmp_path / "track") is None
    for text in ("", "0:4", "0:4\n4:"):
        groups_path(tmp_path / "track").write_text(text)
        assert read_groups(tmp_path / "track") is None


@pytest.mark.parametrize("text", [b"\n", b"four\n", b"0:4 4\n", b"0-4\n", b"\xff\xfe\n", b"0:4\n8:12\n", b"4:8\n"])
def test_what_are_no_groups_is_reported(tmp_path: Path, text: bytes) -> None:
    groups_path(tmp_path / "track").write_bytes(text)
    with pytest.raises(StreamError, match=r"track\.groups"):
        read_groups(tmp_path / "track")


@given(st.integers(1, 200), st.integers(1, 40))
def test_equal_groups_have_every_frame_once(frames: int, length: int) -> None:
    groups = equal_groups(frames, length)
    assert [frame for first, end in groups for frame in range(first, end)] == [*range(frames)]
    assert all(end - first == length for first, end in groups[:-1])
    assert groups[-1][1] - groups[-1][0] in range(2, length + 2) or length == 1 or frames == 1


def test_a_last_frame_by_itself_goes_to_the_group_before() -> None:
    assert equal_groups(61, 30) == [(0, 30), (30, 61)]
    assert equal_groups(62, 30) == [(0, 30), (30, 60), (60, 62)]
    assert equal_groups(1, 30) == [(0, 1)]
    assert equal_groups(3, 1) == [(0, 1), (1, 2), (2, 3)], "as was asked for"
    assert quiet_groups(61, 30, {30: 0.1, 60: 0.0}) == [(0, 30), (30, 61)]


@given(st.integers(1, 20), st.integers(1, 4), st.data())
def test_quiet_groups_have_every_frame_once_and_begin_at_candidates(
    units: int, every: int, data: st.DataObject
) -> None:
    frames = units * every
    changed = {at: data.draw(st.floats(0, 1)) for at in range(every, frames, every)}
    length = every * data.draw(st.integers(1, 4))
    groups = quiet_groups(frames, length, changed)
    assert [frame for first, end in groups for frame in range(first, end)] == [*range(frames)]
    assert {first for first, _ in groups[1:]} <= changed.keys()
    assert all(end - first <= length + length // 2 for first, end in groups)


def test_borders_lie_where_little_moves() -> None:
    changed = dict.fromkeys(range(10, 100, 10), 0.3) | {30: 0.01, 60: 0.02}
    assert quiet_groups(100, 30, changed) == [(0, 30), (30, 60), (60, 100)]
    shifted = dict.fromkeys(range(10, 100, 10), 0.3) | {20: 0.01, 60: 0.02}
    assert quiet_groups(100, 30, shifted) == [(0, 20), (20, 60), (60, 100)]


def test_a_length_off_the_key_packets_is_refused_with_the_nearest_that_is_on_them() -> None:
    check_length(60, key_interval=30)
    with pytest.raises(ConfigError, match="one every 30 frames .* take 60"):
        check_length(50, key_interval=30)
    with pytest.raises(ConfigError, match="Groups of 0 frames"):
        check_length(0, key_interval=30)
