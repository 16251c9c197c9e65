# SPDX-License-Identifier: Apache-2.0
"""The capture of a group is the header's, or refused."""

from dataclasses import replace

import pytest
import torch

from structgstream.errors import CaptureError
from structgstream.groups.base import GroupBase, fingerprint, open_for
from tests.support.clip_groups import CAPTURE, made


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
