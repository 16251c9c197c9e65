# SPDX-License-Identifier: Apache-2.0
"""Peers run, break off, go on and are scored like the variants of our own method."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from small_runs import CLIP as LARGER
from structgstream.errors import ConfigError
from structgstream.evaluation.run_log import log_path, read_log
from structgstream_studies.experiments.peer_runs import PEER_TITLES, PeerRun
from structgstream_studies.experiments.results import read_result
from structgstream_studies.experiments.studies import (
    comparison_runs,
    fits_frames_alone,
    with_dependencies,
    write_methods,
)
from structgstream_studies.peers import methods
from structgstream_studies.peers.methods import METHODS, TINY_METHODS, AnyMethod, open_peer
from structgstream_studies.peers.threedgs import ThreeDGS
from tests.support.backends import quickest_backend

BACKEND = quickest_backend()
CLIP = replace(LARGER, scale=0.125)
"""Peers take every point that is found, in every frame."""


def quick_methods() -> Mapping[str, AnyMethod]:
    """3DGS with next to no iterations."""
    tiny = TINY_METHODS["3dgs"].config
    return {**TINY_METHODS, "3dgs": ThreeDGS(replace(tiny, iterations=3, coarse_iterations=0))}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(methods, "METHODS", quick_methods())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PeerRun]:
    """3DGS on frames 0 and 2."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "METHODS", quick_methods())
        peer = PeerRun("3dgs", replace(CLIP, every=2), 0, tmp_path_factory.mktemp("peer"), 2)
        assert not peer.done()
        peer.run(BACKEND)
        yield peer


def test_a_peer_is_scored_by_the_same_evaluator(run: PeerRun) -> None:
    result = read_result(run.result)
    assert result is not None
    assert (result.key, result.identity["method"], result.seed, result.capture) == ("3dgs", "3dgs", 0, "clip")
    assert result.identity["config"]["iterations"] == 3
    assert result.identity["capture"]["every"] == 2
    assert len(result.frames) == 2
    assert 5 < result.mean["psnr"] < 40
    assert result.mean["online_bytes"] > 1000
    assert result.frames[1]["cpu_seconds"] > 0
    assert result.trained_by["backend"] == BACKEND.name
    assert run.done()
    assert run.needs == ()


def test_a_result_of_a_peer_answers_its_own_question(run: PeerRun, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not replace(run, seed=1).done()
    assert not replace(run, capture=CLIP, frames=3).done()
    assert not replace(run, key="scaffold-gs").done()
    monkeypatch.setattr(methods, "METHODS", METHODS)
    assert not run.done()


def test_a_peer_that_broke_off_goes_on_after_its_whole_frames(run: PeerRun, tmp_path: Path) -> None:
    other = replace(run, folder=tmp_path)
    other.stream.parent.mkdir()
    second = open_peer(run.stream).packets[1]
    other.stream.write_bytes(run.stream.read_bytes()[: second.offset + second.bytes // 2])
    lines = log_path(run.stream).read_text().splitlines(keepends=True)
    log_path(other.stream).write_text(lines[0] + lines[1][:30])
    assert not other.done()
    other.run(BACKEND)
    assert other.done()
    assert other.stream.read_bytes() == run.stream.read_bytes()
    entries, expected = read_log(other.stream), read_log(run.stream)
    assert entries.keys() == expected.keys() == {0, 1}
    assert entries[0] == expected[0]
    assert entries[1]["cpu_seconds"] != expected[1]["cpu_seconds"]


@pytest.mark.parametrize("part", [{"start": 1}, {"every": 1}, {"scale": 0.5}])
def test_a_file_of_other_pictures_is_refused_and_stays(run: PeerRun, part: dict[str, Any]) -> None:
    before = run.stream.read_bytes()
    with pytest.raises(ConfigError, match="made (with|from) another"):
        replace(run, capture=replace(run.capture, **part), frames=3).run(BACKEND)
    assert run.stream.read_bytes() == before
    assert run.done()


def test_a_peer_that_is_whole_is_only_scored(run: PeerRun, monkeypatch: pytest.MonkeyPatch) -> None:
    log, written = log_path(run.stream).read_bytes(), run.stream.stat().st_mtime_ns
    monkeypatch.setattr(ThreeDGS, "first", lambda *_, **__: pytest.fail("fitted again"))
    run.result.unlink()
    run.run(BACKEND)
    assert run.done()
    assert (log_path(run.stream).read_bytes(), run.stream.stat().st_mtime_ns) == (log, written)


def test_methods_that_fit_frames_alone_do_so_for_some_frames(tmp_path: Path) -> None:
    runs = comparison_runs(list(PEER_TITLES), CLIP, frames=12, alone_every=5, seeds=(0, 1), folder=tmp_path)
    assert {(one.key, one.capture.every, one.frames) for one in runs} == {
        ("3dgstream", 1, 12),
        ("scaffold-gs", 5, 3),
        ("3dgs", 5, 3),
    }
    assert len(runs) == len({one.name for one in runs}) == 6
    assert [task.name for task in with_dependencies(runs)] == [one.name for one in runs]
    assert not fits_frames_alone("rig")


def test_every_peer_has_a_title_and_every_title_a_peer() -> None:
    assert PEER_TITLES.keys() == METHODS.keys()


def test_the_comparison_shows_what_was_run(run: PeerRun, tmp_path: Path) -> None:
    sheet = write_methods(tmp_path, [run], backend=BACKEND)
    assert [row[:2] for row in sheet.rows] == [[PEER_TITLES["3dgs"], "1"]]
    assert {path.name for path in tmp_path.iterdir()} == {"methods.md", "methods.png", "methods-detail.png"}
