# SPDX-License-Identifier: Apache-2.0
"""A group of frames is fitted into a segment, whatever interrupts it."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.api import reconstruct
from structgstream.atomic_files import partial_path
from structgstream.errors import CaptureError, ConfigError, StreamError
from structgstream.groups.base import GroupBase
from structgstream.groups.segment_file import GroupSoFar, open_segment
from structgstream.scene.state import state_of
from tests.support.backends import quickest_backend
from tests.support.clip_groups import CAPTURE, LENGTH, fit, made, task
from tests.support.small_presets import QUICK


def test_stopped_between_frames_and_within_one_it_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    """Cuts at other bytes: test_segment_file.py and test_segment_sink.py."""
    path, whole = tmp_path / "g.sgs", made().segments[1].read_bytes()
    assert fit(path, task(made(), LENGTH), stop_after=1) == 1
    assert not path.exists()
    assert len(open_segment(partial_path(path)).entries) == 1
    end = partial_path(path).stat().st_size
    partial_path(path).write_bytes(whole[: end + 3])
    assert fit(path, task(made(), LENGTH)) == 1
    assert path.read_bytes() == whole


def test_the_group_of_frame_0_is_that_of_any_stream(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    reconstruct(CAPTURE, path, preset=QUICK, scale=0.25, frames=LENGTH, backend=quickest_backend())
    data, found = path.read_bytes(), open_segment(made().segments[0])
    for number in range(LENGTH):
        assert found.record(number) in data


def test_what_does_not_move_keeps_the_bits_of_frame_0() -> None:
    base = GroupBase.read(made().header)
    found = open_segment(made().segments[2])
    scene = GroupSoFar(base, 2 * LENGTH, [found.record(0)]).scene(2 * LENGTH)
    first, then = state_of(base.scene()), state_of(scene)
    still = (first["anchor_positions"] == then["anchor_positions"]).all(1)
    assert 0.3 < still.float().mean() < 1.0
    rows = (first["appearance"] == then["appearance"]).all(1) & still
    assert rows.float().mean() > 0.2


def test_another_group_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    shutil.copy(made().segments[1], path)
    with pytest.raises(ConfigError, match="another track and first and end"):
        fit(path, task(made(), 2 * LENGTH))
    with pytest.raises(ConfigError, match="another options"):
        fit(path, replace(task(made(), LENGTH), start=replace(task(made(), 0).start, iterations=8)))
    assert path.read_bytes() == made().segments[1].read_bytes()
    assert fit(path, task(made(), 2 * LENGTH), overwrite=True, stop_after=1) == 1
    assert open_segment(partial_path(path)).entries[0][0] == 2 * LENGTH


def test_ranges_that_are_none_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "g.sgs"
    with pytest.raises(ConfigError, match="needs a track"):
        fit(path, replace(task(made(), 2), track=None))
    with pytest.raises(StreamError, match="no start at frame 3"):
        fit(path, task(made(), 3))
    with pytest.raises(CaptureError, match="has 12 frames"):
        fit(path, task(made(), 2, end=13))
