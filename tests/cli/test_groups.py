# SPDX-License-Identifier: Apache-2.0
"""Commands of groups: what track, fit-group and join ask for, say when they end, and refuse."""

import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from structgstream.atomic_files import partial_path
from structgstream.cli import main
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.groups import base, track_pass, unit
from structgstream.groups.first_frame import GroupStartConfig
from structgstream.groups.join import join_segments
from structgstream.groups.track_file import TrackHead, TrackWriter, groups_path
from structgstream.session.presets import TINY, to_json
from structgstream.training.result import Step
from tests.support.quick_streams import CLIP, Runner
from tests.support.reports import frame_report
from tests.support.small_segments import FIRST, FROM_FRAME_0, encoded, write
from tests.support.streams import header_for, small_scene, small_stream, write_stream

FRAMES = 12


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command, with a header of the preset tiny, and a capture of 12 frames."""
    scene = small_scene()
    header = replace(header_for(scene), config=to_json(TINY))
    write_stream(FileSink(tmp_path / "header.sgs"), [scene], header=header)
    monkeypatch.setattr(base, "open_for", lambda header, capture, *, frames: range(frames or FRAMES))
    given = ["--init", str(tmp_path / "header.sgs"), "-o", str(tmp_path / "new" / "track"), "--device", "cpu"]
    return ["track", CLIP, *given]


def end(then: object) -> None:
    """Ends what runs by an error or by SIGTERM, or not if ``then`` is None."""
    if isinstance(then, BaseException):
        raise then
    if then is not None:
        os.kill(os.getpid(), signal.SIGTERM)


def tracks(monkeypatch: pytest.MonkeyPatch, *, then: object = None) -> list[Any]:
    """A pass that writes a track of three groups, which ``then`` ends after frame 4; returns what it is asked for."""
    asked: list[Any] = []

    def track(path: Path, source: Any, base: Any, options: Any, backend: Any) -> Iterator[Any]:
        asked.append((source, options))
        writer = TrackWriter(path, TrackHead("ab", "cd", 0.01, 5, 4, {}))
        try:
            for frame in range(1, len(source)):
                if frame == 5:
                    end(then)
                yield SimpleNamespace(frame=frame, cpu_seconds=0.25 * (1 + frame % 2))
            writer.finish(len(source), [(0, 4), (4, 8), (8, 12)])
        finally:
            writer.close()

    monkeypatch.setattr(track_pass, "track_capture", track)
    return asked


def test_what_is_asked_for_is_tracked(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner
) -> None:
    asked = tracks(monkeypatch)
    given = ["--groups", "7", "--allow-unaligned", "--split-at-low-motion", "--cameras", "9", "--frames", "11"]
    out = run([*words, *given]).out
    ((source, options),) = asked
    assert len(source) == 11
    assert (options.length, options.quiet, options.after, options.tracking.cameras) == (7, True, None, 9)
    assert f"Wrote {tmp_path}/new/track: 11 frames, " in out
    assert "; 3 groups in " in out
    assert ": 0:4 4:8 8:12; 0.38 core-seconds a frame" in out


def test_a_group_is_a_key_interval_long_unless_asked(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    asked = tracks(monkeypatch)
    assert main(words) == 0
    assert asked[0][1].length == 30


@pytest.mark.parametrize(("then", "status", "tracked"), [(KeyboardInterrupt(), 130, 4), ("SIGTERM", 143, 5)])
def test_interrupted_it_says_how_far_it_is(
    words: list[str], monkeypatch: pytest.MonkeyPatch, run: Runner, then: object, status: int, tracked: int
) -> None:
    tracks(monkeypatch, then=then)
    error = run(words, status=status).err
    assert f"Frame {tracked} of 11 was tracked; give the same command to go on from the last start." in error


def test_overwrite_removes_what_is_there_and_nothing_else_does(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracks(monkeypatch, then=KeyboardInterrupt())
    path = tmp_path / "new" / "track"
    path.parent.mkdir()
    there = (path, partial_path(path), groups_path(path))
    for each in there:
        each.write_bytes(b"before")
    assert main([*words, "--cameras", "1"]) == 2
    assert main([*words, "--overwrite", "--after", "absent.sgs"]) == 1
    assert all(each.read_bytes() == b"before" for each in there)
    assert main([*words, "--overwrite"]) == 130
    assert not path.exists()
    assert not groups_path(path).exists()
    assert partial_path(path).read_bytes() != b"before"


@pytest.mark.parametrize(
    ("given", "status", "said"),
    [
        (["--groups", "7"], 2, "one every 30 frames"),
        (["--groups", "0", "--allow-unaligned"], 2, "0"),
        (["--cameras", "1"], 2, "--cameras must be at least 2, got 1."),
        (["--after", "absent.sgs"], 1, "Cannot read absent.sgs"),
    ],
)
def test_what_is_refused_is_one_sentence(
    words: list[str], monkeypatch: pytest.MonkeyPatch, run: Runner, given: list[str], status: int, said: str
) -> None:
    asked = tracks(monkeypatch)
    error = run([*words, *given], status=status).err
    assert said in error
    assert error.count("\n") == 1
    assert not asked


@pytest.fixture
def given_group(tmp_path: Path) -> list[str]:
    (tmp_path / "header.sgs").write_bytes(small_stream(1))
    return ["fit-group", CLIP, "--init", str(tmp_path / "header.sgs"), "-o", str(tmp_path / "g.sgs")]


def fits(monkeypatch: pytest.MonkeyPatch, *, done: int, then: object = None) -> list[Any]:
    """A fit of frames 60 to 63, which ``then`` ends after two; returns what it is asked for."""
    asked: list[Any] = []

    def fit(path: Path, task: unit.SegmentTask, backend: object, *, overwrite: bool, on_step: Any) -> Any:
        def reports() -> Iterator[Any]:
            for index in range(done, task.end):
                if index == done + 2:
                    end(then)
                on_step(Step(1, 2, 0.5, 10, 0))
                yield frame_report(index)

        asked.append((path, task, overwrite))
        return SimpleNamespace(done=done, reports=reports())

    monkeypatch.setattr(unit, "fit_segment", fit)
    return asked


def test_what_is_asked_for_is_fitted_and_shown(
    given_group: list[str], monkeypatch: pytest.MonkeyPatch, run: Runner
) -> None:
    asked = fits(monkeypatch, done=61)
    given = ["--frames", "60:63", "--track", "t", "--iterations", "9", "--rounds", "2", "--overwrite"]
    *frames, last = run([*given_group, *given, "--device", "cpu"]).out.splitlines()
    start = GroupStartConfig(iterations=9, rounds=2)
    task = unit.SegmentTask(Path(CLIP), Path(given_group[3]), Path("t"), 60, 63, start)
    assert asked == [(Path(given_group[5]), task, True)]
    assert [line.split("  ")[0] for line in frames] == ["frame 62/63", "frame 63/63"]
    assert last == f"Wrote {given_group[5]}"


def test_a_finished_segment_is_said_to_be(given_group: list[str], monkeypatch: pytest.MonkeyPatch, run: Runner) -> None:
    monkeypatch.setattr(unit, "fit_segment", lambda *given, **options: None)
    assert run([*given_group, "--frames", "0:2", "--device", "cpu"]).out == f"{given_group[5]} is finished.\n"


@pytest.mark.parametrize(("then", "status"), [(KeyboardInterrupt(), 130), ("SIGTERM", 143)])
def test_interrupted_it_says_what_is_safe(
    given_group: list[str], monkeypatch: pytest.MonkeyPatch, run: Runner, then: object, status: int
) -> None:
    fits(monkeypatch, done=61, then=then)
    error = run([*given_group, "--frames", "60:66", "--device", "cpu"], status=status).err
    # At SIGTERM the frame that is being fitted is finished.
    safe = 3 if status == 130 else 4
    assert f"{safe} of 6 frames are safe; give the same command to go on." in error


def test_ranges_and_numbers_that_mean_nothing_are_refused(
    given_group: list[str], run: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = fits(monkeypatch, done=0)
    for given, said in (
        (["--frames", "4"], "--frames 4: a group is A:B, such as --frames 60:120."),
        (["--frames", "4:x"], "a group is A:B"),
        (["--frames", "-1:4"], ""),
        (["--frames", "4:4"], "--frames 4:4 is empty; B is the frame after the last one."),
        (["--frames", "5:4"], "is empty"),
        (["--frames", "0:4", "--iterations", "0"], "--iterations and --rounds must be at least 1."),
        (["--frames", "0:4", "--rounds", "0"], "--iterations and --rounds must be at least 1."),
    ):
        assert said in run([*given_group, *given], status=2).err
    assert not asked


def test_a_group_without_a_track_and_a_header_that_is_none_are_reported(
    given_group: list[str], tmp_path: Path, run: Runner
) -> None:
    (tmp_path / "header.sgs").write_bytes(b"A letter to someone.")
    error = run([*given_group, "--frames", "2:4", "--device", "cpu"], status=1).err
    assert "is not a structgstream file" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "g.sgs").exists()


@pytest.fixture
def segments(tmp_path: Path) -> list[str]:
    (tmp_path / "g").mkdir()
    first = write(tmp_path / "g" / "g0.sgs", encoded(1, FIRST)[0], identity=FROM_FRAME_0)
    return [str(first), str(write(tmp_path / "g" / "g3.sgs", encoded()[0]))]


def test_segments_become_a_stream_in_any_order(segments: list[str], tmp_path: Path, run: Runner) -> None:
    out = tmp_path / "out.sgs"
    assert f"Wrote {out}: 7 frames of 2 groups, " in run(["join", *reversed(segments), "-o", str(out)]).out
    with open_stream(out) as reader:
        assert (len(reader), reader.complete) == (7, True)
    assert "3 frames of 1 groups" in run(["join", segments[0], "-o", str(out), "--overwrite"]).out


def test_plain_copies_the_packets_of_every_group(segments: list[str], tmp_path: Path) -> None:
    out, copied = tmp_path / "out.sgs", tmp_path / "copied.sgs"
    assert main(["join", *segments, "-o", str(out), "--plain"]) == 0
    join_segments([Path(segment) for segment in segments], copied)
    assert out.read_bytes() == copied.read_bytes()


def test_what_is_there_is_replaced_only_when_asked(segments: list[str], tmp_path: Path, run: Runner) -> None:
    out = tmp_path / "out.sgs"
    out.write_bytes(b"mine")
    error = run(["join", *segments, "-o", str(out)], status=2).err
    assert error == f"structgstream: {out} exists; replace it with --overwrite, or choose another name.\n"
    assert out.read_bytes() == b"mine"


def test_what_is_refused_is_one_sentence_and_leaves_nothing(segments: list[str], tmp_path: Path, run: Runner) -> None:
    out, cut = tmp_path / "out.sgs", tmp_path / "cut.sgs"
    cut.write_bytes(Path(segments[1]).read_bytes()[:-40])
    for given, status, said in (
        ([], 2, "join needs the segments of a stream."),
        (segments[1:], 1, "Frames 0 to 2 are missing"),
        ([*segments, segments[1]], 1, "Frames 3 to 6 are duplicated"),
        ([segments[0], str(cut)], 1, "cut.sgs is not finished or damaged"),
        ([str(tmp_path / "absent.sgs")], 1, "Cannot read"),
    ):
        error = run(["join", *given, "-o", str(out)], status=status).err
        assert said in error
        assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.sgs", "g"]
