# SPDX-License-Identifier: Apache-2.0
"""``track``: what it asks for, and says when it ends; the pass itself is ``groups/track_pass``'s."""

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
from structgstream.codec.sinks import FileSink
from structgstream.groups import base, track_pass
from structgstream.groups.track_file import TrackHead, TrackWriter, groups_path
from structgstream.session.presets import TINY, to_json
from tests.support.quick_streams import CLIP, error_of
from tests.support.streams import header_for, small_scene, write_stream

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


def tracks(monkeypatch: pytest.MonkeyPatch, *, then: object = None) -> list[Any]:
    """A pass that writes a track of three groups, which ``then`` ends after frame 4; returns what it is asked for."""
    asked: list[Any] = []

    def track(path: Path, source: Any, base: Any, options: Any, backend: Any) -> Iterator[Any]:
        asked.append((source, options))
        writer = TrackWriter(path, TrackHead("ab", "cd", 0.01, 5, 4, {}))
        try:
            for frame in range(1, len(source)):
                if then is not None and frame == 5:
                    if isinstance(then, BaseException):
                        raise then
                    os.kill(os.getpid(), signal.SIGTERM)
                yield SimpleNamespace(frame=frame, cpu_seconds=0.25 * (1 + frame % 2))
            writer.finish(len(source), [(0, 4), (4, 8), (8, 12)])
        finally:
            writer.close()

    monkeypatch.setattr(track_pass, "track_capture", track)
    return asked


def test_what_is_asked_for_is_tracked(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = tracks(monkeypatch)
    assert (
        main(
            [*words, "--groups", "7", "--allow-unaligned", "--split-at-low-motion", "--cameras", "9", "--frames", "11"]
        )
        == 0
    )
    ((source, options),) = asked
    assert len(source) == 11
    assert (options.length, options.quiet, options.after, options.tracking.cameras) == (7, True, None, 9)
    out = capsys.readouterr().out
    assert f"Wrote {tmp_path}/new/track: 11 frames, " in out
    assert "; 3 groups in " in out
    assert ": 0:4 4:8 8:12; 0.38 core-seconds a frame" in out


def test_a_group_is_a_key_interval_long_unless_asked(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    asked = tracks(monkeypatch)
    assert main(words) == 0
    assert asked[0][1].length == 30


@pytest.mark.parametrize(("then", "status", "tracked"), [(KeyboardInterrupt(), 130, 4), ("SIGTERM", 143, 5)])
def test_interrupted_it_says_how_far_it_is(
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    then: object,
    status: int,
    tracked: int,
) -> None:
    tracks(monkeypatch, then=then)
    error = error_of(words, capsys, status=status)
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
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    given: list[str],
    status: int,
    said: str,
) -> None:
    asked = tracks(monkeypatch)
    error = error_of([*words, *given], capsys, status=status)
    assert said in error
    assert error.count("\n") == 1
    assert not asked
