# SPDX-License-Identifier: Apache-2.0
"""A file that grows is in the store as its last attempt has it, whatever earlier attempts have left there."""

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from properties import examples
from structgstream.parallel.object_folder import ObjectFolder
from structgstream.parallel.pieces import GrowingCopy, last_pieces, piece_name
from structgstream.whole_files import partial_path

FIRST, SECOND = "000001-89abcdef", "000002-01234567"


@pytest.fixture
def store(tmp_path: Path) -> ObjectFolder:
    return ObjectFolder(f"file://{tmp_path / 'store'}")


@examples(80)
@given(st.binary(max_size=40), st.data())
def test_pieces_are_read_from_any_byte_to_the_first_that_is_missing(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, choice: st.DataObject
) -> None:
    store = ObjectFolder(f"file://{tmp_path_factory.mktemp('store')}")
    cuts = sorted({0, len(data), *choice.draw(st.lists(st.integers(0, len(data)), max_size=6))})
    missing = choice.draw(st.sampled_from([None, *cuts[:-1]]))
    for begins, end in pairwise(cuts):
        if begins != missing:
            store.write(piece_name("t", FIRST, begins), data[begins:end])
    reached = len(data) if missing is None else missing
    have = choice.draw(st.integers(0, reached))
    assert last_pieces(store, "t").read(store, have=have) == data[have:reached]


def test_the_last_attempt_counts(store: ObjectFolder) -> None:
    assert (last_pieces(store, "t").attempt, last_pieces(store, "t").read(store)) == ("", b"")
    store.write(piece_name("t", FIRST, 0), b"first and longer")
    store.write(piece_name("t", FIRST, 16), b" still")
    store.write(piece_name("t", SECOND, 0), b"second")
    store.write("t.pieces/000000000000003", b"of an earlier version")
    found = last_pieces(store, "t")
    assert (found.attempt, found.read(store)) == (SECOND, b"second")
    store.write(piece_name("t", FIRST, 22), b"; what was given up is alive")
    assert last_pieces(store, "t").read(store) == b"second"


def test_what_has_not_grown_is_not_taken_again(store: ObjectFolder, tmp_path: Path) -> None:
    copy = GrowingCopy(store, "t", of=tmp_path / "t")
    copy.take()
    assert not last_pieces(store, "t").names
    partial_path(tmp_path / "t").write_bytes(b"abc")
    for _ in range(2):
        copy.take()
    partial_path(tmp_path / "t").write_bytes(b"abcde")
    copy.take()
    partial_path(tmp_path / "t").rename(tmp_path / "t")
    copy.take()
    assert [*last_pieces(store, "t").names] == [0, 3]


@pytest.mark.parametrize("now", [b"abX", b"ab", b"abXYZ", b""])
def test_a_file_that_is_no_longer_what_was_taken_begins_another_attempt(
    store: ObjectFolder, tmp_path: Path, now: bytes
) -> None:
    path = partial_path(tmp_path / "t")
    path.write_bytes(b"abcd")
    copy = GrowingCopy(store, "t", of=tmp_path / "t")
    copy.take()
    before = last_pieces(store, "t").attempt
    path.write_bytes(now)
    copy.take()
    path.write_bytes(now + b"!")
    copy.take()
    found = last_pieces(store, "t")
    assert found.attempt > before
    assert found.read(store) == now + b"!"


def test_two_attempts_at_a_time_do_not_mix(store: ObjectFolder, tmp_path: Path) -> None:
    """What was given up for lost is alive."""
    contents = {"a": b"", "b": b""}
    copies = {name: GrowingCopy(store, "t", of=tmp_path / name / "t") for name in contents}
    for step in range(6):
        for name, copy in copies.items():
            contents[name] += name.encode() * (1 + step)
            (tmp_path / name).mkdir(exist_ok=True)
            partial_path(tmp_path / name / "t").write_bytes(contents[name])
            copy.take()
            assert last_pieces(store, "t").read(store) in contents.values()
