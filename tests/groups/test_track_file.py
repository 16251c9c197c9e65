# SPDX-License-Identifier: Apache-2.0
"""The file of a tracking pass."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.atomic_files import partial_path
from structgstream.errors import StreamError
from structgstream.groups.track_file import PREFIX, SIGNATURE, TrackHead, TrackStart, TrackWriter, open_track
from tests.support.killed import folders_of_the_killed

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
    path = tmp_path / "t"
    path.write_bytes(b"")
    with pytest.raises(StreamError, match="is no track"):
        open_track(path)
    path.write_bytes(PREFIX.pack(SIGNATURE, 9, 0))
    with pytest.raises(StreamError, match="version 9"):
        open_track(path)
    path.write_bytes(PREFIX.pack(SIGNATURE, 1, 0) + b"xx")
    with pytest.raises(StreamError, match="is damaged"):
        open_track(path)
