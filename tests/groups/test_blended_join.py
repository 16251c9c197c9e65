# SPDX-License-Identifier: Apache-2.0
"""Packets of a joined stream after a seam blend: they decode, and borders flicker less."""

from pathlib import Path

import torch

from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import open_stream
from structgstream.groups.join import join_segments
from structgstream.groups.seam_blend import Border
from structgstream.scene.scene import Scene
from tests.support.backends import quickest_backend
from tests.support.clip_groups import FRAMES, LENGTH, made


def scenes_of(path: Path) -> list[Scene]:
    with open_stream(path) as reader:
        return [scene for _, scene in reader.scenes()]


def unmoved(one: Scene, other: Scene) -> int:
    return int((one.anchors.positions == other.anchors.positions).all(1).sum())


def test_more_anchors_keep_their_bits_across_borders(tmp_path: Path) -> None:
    plain, handed = tmp_path / "plain.sgs", tmp_path / "handed.sgs"
    join_segments(made().segments, plain, check=True)
    borders: list[Border] = []
    backend = quickest_backend()
    assert join_segments(made().segments, handed, check=True, backend=backend, on_border=borders.append) == FRAMES
    assert [border.frame for border in borders] == list(range(LENGTH, FRAMES, LENGTH))
    assert all(border.blended > 0 <= border.withdrawn for border in borders)
    before, after = scenes_of(plain), scenes_of(handed)
    for index in range(LENGTH):
        assert torch.equal(before[index].anchors.positions, after[index].anchors.positions)
    for border in range(LENGTH, FRAMES, LENGTH):
        assert unmoved(after[border - 1], after[border]) > unmoved(before[border - 1], before[border])
    with open_stream(plain) as one, open_stream(handed) as other:
        assert [info.kind for info in one.packets] == [info.kind for info in other.packets]
        assert [info.pts_seconds for info in one.packets] == [info.pts_seconds for info in other.packets]
        assert other.packets[LENGTH].kind is PacketKind.KEY
