# SPDX-License-Identifier: Apache-2.0
"""The serial pass: interrupted anywhere it writes the same track."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from structgstream.atomic_files import partial_path
from structgstream.errors import ConfigError
from structgstream.groups.base import GroupBase
from structgstream.groups.segment_file import GroupSoFar, open_segment
from structgstream.groups.track_file import groups_path, open_track
from tests.support.clip_groups import FRAMES, LENGTH, OPTIONS, made, track


def test_a_track_has_a_start_for_each_group() -> None:
    found = open_track(made().track)
    assert found.starts == [2, 4]
    assert found.groups == [(0, 2), (2, 4), (4, 6)]
    assert groups_path(made().track).read_text() == "0:2\n2:4\n4:6\n"
    start = found.start(4)
    assert len(start.primitives) > 10
    assert len(start.changed) == LENGTH
    assert ((start.displacements != 0) | (start.velocities != 0)).any(1).all()


def test_interrupted_it_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    path = tmp_path / "track"
    assert track(path, made().header, stop_after=3) == 3
    assert not path.exists()
    assert track(path, made().header) == 3
    assert path.read_bytes() == made().track.read_bytes()


def test_cut_in_a_record_it_goes_on_before_that(tmp_path: Path) -> None:
    path, whole = tmp_path / "track", made().track.read_bytes()
    finished = [(path, len(whole) - 200), (path, len(whole) - 1)]  # damaged after their end
    for found, cut in [(partial_path(path), 200), (partial_path(path), len(whole) - 200), *finished]:
        found.write_bytes(whole[:cut])
        track(path, made().header)
        assert path.read_bytes() == whole
        path.unlink()


def test_killed_between_the_last_byte_and_the_name_it_gets_its_name(tmp_path: Path) -> None:
    path, whole = tmp_path / "track", made().track.read_bytes()
    for groups_there in (True, False):
        partial_path(path).write_bytes(whole)
        if groups_there:
            groups_path(path).write_text("0:2\n2:4\n4:6\n")
        assert track(path, made().header) == 0
        assert path.read_bytes() == whole
        assert groups_path(path).read_text() == "0:2\n2:4\n4:6\n"
        assert sorted(tmp_path.iterdir()) == [path, groups_path(path)]
        path.unlink()
        groups_path(path).unlink()


def test_a_finished_track_is_left_and_another_is_refused(tmp_path: Path) -> None:
    assert track(made().track, made().header) == 0
    with pytest.raises(ConfigError, match="a track of another every and config"):
        track(made().track, made().header, options=replace(OPTIONS, length=3))


def test_quiet_groups_begin_at_starts(tmp_path: Path) -> None:
    path = tmp_path / "track"
    assert track(path, made().header, options=replace(OPTIONS, length=2, quiet=True)) == FRAMES - 1
    found = open_track(path)
    assert {first for first, _ in found.groups[1:]} <= set(found.starts)
    assert found.groups[-1][1] == FRAMES


def test_after_a_finished_group_it_begins_where_that_has_fitted_things(tmp_path: Path) -> None:
    base, group = GroupBase.read(made().header), open_segment(made().segments[1])
    path = tmp_path / "track"
    options = replace(OPTIONS, after=group)
    assert track(path, made().header, options=options) == FRAMES - 4
    found = open_track(path)
    assert (found.starts, found.groups) == ([3, 4], [(4, 6)])
    fitted = GroupSoFar(base, 2, [group.record(0), group.record(1)]).scene(3)
    start = found.start(3)
    z = base.scene().anchors.positions
    moved = z.clone()
    moved[torch.from_numpy(start.primitives).long()] += torch.from_numpy(start.displacements) * base.position_step
    torch.testing.assert_close(moved, fitted.anchors.positions, atol=1e-6, rtol=0)
    whole = path.read_bytes()
    path.unlink()
    assert track(path, made().header, options=options, stop_after=1) == 1
    track(path, made().header, options=options)
    assert path.read_bytes() == whole


def test_a_group_that_ends_with_the_frames_has_none_after_it(tmp_path: Path) -> None:
    options = replace(OPTIONS, after=open_segment(made().segments[2]))
    with pytest.raises(ConfigError, match=r"has the frames to before 6, and 6 frames are to be tracked, so none is"):
        track(tmp_path / "track", made().header, options=options)
    assert not [*tmp_path.iterdir()]
