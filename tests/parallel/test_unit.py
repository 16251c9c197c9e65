# SPDX-License-Identifier: Apache-2.0
"""The commands of a parallel run, which the programs understand."""

from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.cli.groups import FitGroup, Join, Track
from structgstream.cli.options import parse_options
from structgstream.executors.tasks import PYTHON
from structgstream.parallel.driver import Unit
from structgstream.parallel.parts import Parts


@pytest.fixture
def parts(tmp_path: Path) -> Parts:
    return Parts(tmp_path / "parts")


def unit(folder: Path, **given: object) -> Unit:
    (folder / "capture").mkdir()
    return Unit(str(folder / "capture"), device=("--device", "cpu"), **given)  # type: ignore[arg-type]


def after(command: tuple[str, ...], word: str) -> list[str]:
    """What ``structgstream WORD`` is given."""
    assert command[:4] == (PYTHON, "-m", "structgstream", word)
    return [*command[4:]]


def test_the_tracking_pass_is_what_was_asked_for(tmp_path: Path, parts: Parts) -> None:
    task = unit(tmp_path, frames=40, track=("--groups", "8", "--split-at-low-motion")).track_task(parts)
    parts.header.parent.mkdir(parents=True)
    parts.header.touch()
    found = parse_options(Track, "track", arguments=after(task.command, "track"))
    assert (found.scene, found.init, found.output) == (tmp_path / "capture", parts.header, parts.track)
    assert (found.frames, found.groups, found.split_at_low_motion, found.device) == (40, 8, True, "cpu")
    assert (task.name, task.result, task.log) == ("track", str(parts.track), parts.log("track"))
    assert not task.environment


def test_a_group_is_what_was_asked_for(tmp_path: Path, parts: Parts) -> None:
    task = unit(tmp_path).group_task(parts, 8, 16)
    parts.header.parent.mkdir(parents=True)
    parts.header.touch()
    found = parse_options(FitGroup, "fit-group", arguments=after(task.command, "fit-group"))
    assert (found.scene, found.init, found.track) == (tmp_path / "capture", parts.header, parts.track)
    assert (found.frames, found.output, found.device) == ("8:16", parts.segment(8, 16), "cpu")
    assert task.result == str(parts.segment(8, 16))


def test_frame_0_may_be_resumed_and_all_segments_are_joined(tmp_path: Path, parts: Parts) -> None:
    given_unit = unit(tmp_path, header=("--preset", "tiny"))
    words = after(given_unit.header_task(parts).command, "reconstruct")
    assert words == [
        str(tmp_path / "capture"), "-o", str(parts.header), "--frames", "1", "--resume", "--sound", "none",
        "--preset", "tiny", "--device", "cpu",
    ]  # fmt: skip
    task = given_unit.join_task(parts, [(0, 8), (8, 16)], tmp_path / "out.sgs")
    found = parse_options(Join, "join", arguments=after(task.command, "join"))
    assert found.segments == (parts.segment(0, 8), parts.segment(8, 16))
    assert (found.output, found.overwrite) == (tmp_path / "out.sgs", True)
    assert (found.device, found.plain, found.workers) == ("auto", False, None)
    given_unit = replace(given_unit, join=("--device", "reference", "--workers", "3"))
    task = given_unit.join_task(parts, [(0, 8)], tmp_path / "out.sgs")
    found = parse_options(Join, "join", arguments=after(task.command, "join"))
    assert (found.device, found.workers) == ("reference", 3)


def test_without_a_number_all_frames_are_tracked_with_as_many_threads_as_asked(tmp_path: Path, parts: Parts) -> None:
    task = unit(tmp_path, track_threads=3).track_task(parts)
    assert "--frames" not in task.command
    assert task.environment["OMP_NUM_THREADS"] == "3"
