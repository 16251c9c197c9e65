# SPDX-License-Identifier: Apache-2.0
"""What groups share is the beginning of any stream with scene flow."""

from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.codec.reader import open_stream
from structgstream.codec.sound import SoundFormat
from structgstream.errors import ConfigError, StreamError
from structgstream.groups.base import GroupBase
from structgstream.groups.join import join_segments
from tests.support.clip_groups import made
from tests.support.streams import same, small_stream


def test_the_beginning_of_a_longer_stream_is_the_same_base(tmp_path: Path) -> None:
    join_segments(made().segments, tmp_path / "a.sgs")
    short, long = GroupBase.read(made().header), GroupBase.read(tmp_path / "a.sgs")
    assert (short.init, short.first, short.sha256) == (long.init, long.first, long.sha256)
    with open_stream(made().header) as reader:
        assert same(short.scene(), reader.scene(0))
    assert short.key_interval == 30


def test_streams_that_cannot_begin_groups_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    data = made().header.read_bytes()
    path.write_bytes(data[: len(GroupBase.read(made().header).init) + 10])
    with pytest.raises(StreamError, match="no whole frame 0"):
        GroupBase.read(path)
    path.write_bytes(small_stream(1))
    with pytest.raises(ConfigError, match="codec raw and scene flow off"):
        _ = GroupBase.read(path).config
    base = GroupBase.read(made().header)
    heard = replace(base, header=replace(base.header, sound=SoundFormat(1)))
    with pytest.raises(ConfigError, match="has sound, which groups do not carry; make it with --sound none"):
        _ = heard.config
