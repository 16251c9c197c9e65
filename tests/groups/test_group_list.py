# SPDX-License-Identifier: Apache-2.0
"""The list of groups comes back, and what is no list of a whole capture is reported."""

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.errors import StreamError
from structgstream.groups.track_file import groups_path, read_groups, write_groups
from tests.support.properties import examples


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
