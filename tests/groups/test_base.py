# SPDX-License-Identifier: Apache-2.0
"""What groups share: the beginning of any stream with scene flow, and the capture of the header, or none."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from structgstream.codec.reader import open_stream
from structgstream.codec.sound import SoundFormat
from structgstream.errors import CaptureError, ConfigError, StreamError
from structgstream.groups.base import GroupBase, fingerprint, open_for
from structgstream.groups.join import join_segments
from tests.support.clip_groups import CAPTURE, made
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


def test_it_is_opened_as_the_header_says() -> None:
    header = GroupBase.read(made().header).header
    source = open_for(header, CAPTURE, frames=3)
    assert len(source) == 3
    assert source.rig.held_out == header.rig.held_out
    assert {(source.rig[name].width, source.rig[name].height) for name in source.rig} == {(80, 60)}


def test_another_capture_is_refused_by_its_cameras() -> None:
    header = GroupBase.read(made().header).header
    first = header.rig["cam00"]
    longer = first.K * torch.tensor([[1.1, 1.0, 1.0]] * 3, dtype=torch.float64)
    moved = header.rig.mapped({**header.rig.cameras, "cam00": replace(first, K=longer)})
    with pytest.raises(CaptureError, match="not the one of the header: cam00 differs"):
        open_for(replace(header, rig=moved), CAPTURE, frames=3)
    with pytest.raises(CaptureError, match="has 12 frames, but 99 are needed"):
        open_for(header, CAPTURE, frames=99)


def test_the_fingerprint_is_of_calibration_split_and_pictures() -> None:
    header = GroupBase.read(made().header).header
    one = fingerprint(open_for(header, CAPTURE, frames=3))
    assert one == fingerprint(open_for(header, CAPTURE, frames=6))
    other = replace(header, rig=header.rig.with_held_out(frozenset({"cam01"})))
    assert fingerprint(open_for(other, CAPTURE, frames=3)) != one
