# SPDX-License-Identifier: Apache-2.0
"""What moves at a border is found from renderings."""

from dataclasses import replace

import torch

from backends import quickest_backend
from clip_groups import made
from structgstream.groups.base import GroupBase
from structgstream.groups.border import moving_at_border


def test_what_moved_is_found_and_what_did_not_is_not() -> None:
    base = GroupBase.read(made().header)
    first, rig = base.scene(), base.header.similarity.rig(base.header.rig)
    at = first.anchors.positions
    center = at.median(0).values
    there = (at - center).norm(dim=1) < (at - center).norm(dim=1).quantile(0.1)
    before = replace(first, anchors=replace(first.anchors, positions=at + 0.3 * there[:, None]))
    found = moving_at_border(first, first, rig, quickest_backend())
    assert found is not None
    assert not found.any()
    found = moving_at_border(before, first, rig, quickest_backend())
    assert found is not None
    # Pictures of 80x60 show few of the anchors in a heap.
    assert found[there].float().mean() > 3.0 * found[~there].float().mean()
    slowly = replace(first, anchors=replace(first.anchors, positions=at + 1e-4 * there[:, None]))
    for around in ({"second": slowly}, {"earlier": slowly}):
        found = moving_at_border(first, first, rig, quickest_backend(), **around)
        assert found is not None
        assert torch.equal(found, there)


def test_at_a_cut_nothing_is_handed_over() -> None:
    base = GroupBase.read(made().header)
    first, rig = base.scene(), base.header.similarity.rig(base.header.rig)
    gone = replace(first, anchors=replace(first.anchors, positions=first.anchors.positions + 50.0))
    assert moving_at_border(gone, first, rig, quickest_backend(), second=first) is None
