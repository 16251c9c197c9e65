# SPDX-License-Identifier: Apache-2.0
"""Variants on a shared frame 0 give the streams that they give alone, go on where they broke off, and know when a
result answers another question."""

import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from small_runs import CLIP, compact, quick
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink
from structgstream.evaluation.run_log import log_path, read_log
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import state_of
from structgstream.session.loop import Session
from structgstream.session.presets import StreamConfig
from structgstream.session.struct_gstream import stream_pipeline
from structgstream_studies.errors import ExperimentError
from structgstream_studies.experiments.results import Result, read_result
from structgstream_studies.experiments.tasks import FirstFrameRun, VariantRun
from structgstream_studies.experiments.variants import variants
from tests.support.backends import quickest_backend


@dataclass(frozen=True)
class Runs:
    """The full method and one variant, done, with the first frame that they share."""

    folder: Path
    backend: Backend
    first: FirstFrameRun
    full: VariantRun
    held: VariantRun


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder, backend = tmp_path_factory.mktemp("runs"), quickest_backend()
    full = VariantRun("full", CLIP, quick(), folder, 3)
    held = VariantRun("held", CLIP, variants(quick())["held"].config, folder, 3)
    for task in (full.first, full, held):
        task.run(backend)
    return Runs(folder, backend, full.first, full, held)


def result_of(run: VariantRun) -> Result:
    found = read_result(run.result)
    assert found is not None
    return found


def packets(path: Path) -> list[bytes]:
    data = path.read_bytes()
    return [data[info.offset : info.offset + info.bytes] for info in open_stream(path).packets]


def same_scene(one: Scene, other: Scene) -> bool:
    """Whether every piece of two scenes is the same, bit for bit."""
    ours, theirs = state_of(one), state_of(other)
    return ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_a_shared_first_frame_gives_bit_for_bit_the_stream_without_it(runs: Runs, tmp_path: Path) -> None:
    path = tmp_path / "alone.sgs"
    metadata = {"start": CLIP.start, "scale": CLIP.scale}
    session = Session(CLIP.open(), FileSink(path), stream_pipeline(runs.full.config), runs.backend, metadata=metadata)
    assert len([*session.run()]) == 3
    assert packets(path) == packets(runs.full.stream)
    assert path.read_bytes() == runs.full.stream.read_bytes()


def test_variants_of_a_seed_begin_with_one_frame(runs: Runs) -> None:
    assert runs.full.first.name == runs.held.first.name == runs.first.name
    assert packets(runs.first.stream) == packets(runs.full.stream)[:1]
    full, held = (open_stream(run.stream) for run in (runs.full, runs.held))
    assert same_scene(full.scene(0), held.scene(0))
    assert same_scene(held.scene(0), held.scene(2))
    assert not same_scene(full.scene(0), full.scene(2))
    assert result_of(runs.held).frames[2]["train_psnr"] != result_of(runs.full).frames[2]["train_psnr"]


def compact_from_paper_mode() -> StreamConfig:
    """The compact stream with paper mode's frame 0."""
    return replace(compact(), initial=quick().initial, denoising=quick().denoising)


def test_what_decides_frame_0_decides_its_name(runs: Runs) -> None:
    first = runs.first
    other = [
        replace(first, config=quick(seed=1)),
        replace(first, config=variants(quick())["without-distance"].config),
        *(replace(first, capture=replace(CLIP, **part)) for part in ({"start": 1}, {"scale": 0.5}, {"near": 0.3})),
        replace(first, capture=replace(CLIP, held_out=("cam03",))),
    ]
    assert len({first.name, *(one.name for one in other)}) == 7
    same = [
        replace(first, capture=replace(CLIP, frames=7, scored=("cam00",))),
        replace(first, config=variants(quick())["random-spawn"].config),
        replace(first, config=compact_from_paper_mode()),
    ]
    assert {one.name for one in same} == {first.name}


def test_frame_0_is_kept_as_it_was_fitted(runs: Runs, tmp_path: Path) -> None:
    """A compact stream rounds it, by its own steps; what was rounded before would not say what those cost."""
    first = FirstFrameRun(CLIP, compact_from_paper_mode(), tmp_path)
    first.run(runs.backend)
    assert open_stream(first.stream).header.codec == "raw"
    assert packets(first.stream) == packets(runs.first.stream)


def test_what_frame_0_cost_is_what_its_fit_cost(runs: Runs) -> None:
    fit = runs.first.log()
    for run in (runs.full, runs.held):
        assert read_log(run.stream)[0]["cpu_seconds"] == fit["cpu_seconds"] > 0
        assert read_log(run.stream)[0]["train_psnr"] == fit["train_psnr"]
        assert result_of(run).frames[0]["cpu_seconds"] == pytest.approx(fit["cpu_seconds"], rel=1e-5)


def test_a_result_says_what_was_asked_of_what_and_by_whom(runs: Runs) -> None:
    result = result_of(runs.held)
    assert (result.key, result.seed, result.capture) == ("held", 0, "clip")
    assert result.identity["config"]["online"]["iterations"] == 0
    assert result.identity["capture"]["scored"] == ["cam00"]
    assert result.trained_by["backend"] == result.environment["backend"] == runs.backend.name
    assert len(result.frames) == 3
    assert 5 < result.mean["psnr"] < 40
    assert result.mean["online_cpu_seconds"] > 0
    assert result.stream["total_bytes"] == runs.held.stream.stat().st_size


def test_tasks_can_be_sent_to_another_process(runs: Runs) -> None:
    for task in (runs.first, runs.held):
        assert pickle.loads(pickle.dumps(task)) == task


def test_done_tasks_need_nothing_and_are_done(runs: Runs) -> None:
    assert runs.first.done()
    assert runs.full.done()
    assert runs.full.needs == ()
    assert replace(runs.full, folder=runs.folder / "other").needs == (runs.first.name,)


EDITS: dict[str, Callable[[VariantRun], VariantRun]] = {
    "another key": lambda run: replace(run, key="held"),
    "another seed": lambda run: replace(run, config=replace(run.config, seed=1)),
    "another configuration": lambda run: replace(run, config=variants(run.config)["with-color-mlp"].config),
    "fewer frames": lambda run: replace(run, capture=replace(CLIP, frames=2), frames=2),
    "all frames": lambda run: replace(run, capture=replace(CLIP, frames=None), frames=12),
    "another start": lambda run: replace(run, capture=replace(CLIP, start=1)),
    "another scale": lambda run: replace(run, capture=replace(CLIP, scale=0.5)),
    "another near plane": lambda run: replace(run, capture=replace(CLIP, near=0.3)),
    "every second frame": lambda run: replace(run, capture=replace(CLIP, frames=6, every=2)),
    "another camera held out": lambda run: replace(run, capture=replace(CLIP, held_out=("cam01",))),
    "one more camera held out": lambda run: replace(run, capture=replace(CLIP, held_out=("cam00", "cam01"))),
    "another camera scored": lambda run: replace(run, capture=replace(CLIP, scored=("cam01",))),
}


@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS.keys())
def test_a_result_does_not_answer(runs: Runs, tmp_path: Path, edit: Callable[[VariantRun], VariantRun]) -> None:
    asked = replace(edit(runs.full), folder=tmp_path)
    assert not asked.done()
    asked.result.parent.mkdir()
    shutil.copy(runs.full.result, asked.result)
    assert not asked.done()


def test_a_result_answers_the_same_question_in_other_words(runs: Runs) -> None:
    said = replace(CLIP, held_out=("cam00",), scored=("cam00",))
    assert replace(runs.full, capture=said).done()


def broken_off(runs: Runs, folder: Path, *, frames: int) -> VariantRun:
    """The full method as a crash leaves it: some whole frames, half of one, and a log that is one frame behind."""
    run = replace(runs.full, folder=folder)
    run.stream.parent.mkdir()
    third = open_stream(runs.full.stream).packets[frames]
    run.stream.write_bytes(runs.full.stream.read_bytes()[: third.offset + third.bytes // 2])
    lines = log_path(runs.full.stream).read_text().splitlines(keepends=True)
    log_path(run.stream).write_text("".join(lines[:frames]) + lines[frames][:40])
    return run


def test_a_stream_that_broke_off_goes_on_without_fitting_anything_again(runs: Runs, tmp_path: Path) -> None:
    run = broken_off(runs, tmp_path, frames=2)
    assert run.needs == ()
    assert not run.done()
    run.run(runs.backend)
    assert run.stream.read_bytes() == runs.full.stream.read_bytes()
    assert run.done()
    assert not run.first.stream.exists()
    entries, expected = read_log(run.stream), read_log(runs.full.stream)
    assert [entries[i] == expected[i] for i in range(3)] == [True, True, False]
    scores = [[frame["psnr"] for frame in result_of(one).frames] for one in (run, runs.full)]
    assert scores[0] == scores[1]
    assert result_of(run).trained_by == result_of(runs.full).trained_by


def test_a_stream_without_a_whole_frame_begins_anew_with_the_first_frame(runs: Runs, tmp_path: Path) -> None:
    run = broken_off(runs, tmp_path, frames=0)
    assert run.needs == (runs.first.name,)
    shutil.copytree(runs.folder / "first", tmp_path / "first")
    run.run(runs.backend)
    assert run.stream.read_bytes() == runs.full.stream.read_bytes()


@pytest.mark.parametrize("frames", [3, 4], ids=["finished", "to go on with"])
@pytest.mark.parametrize("part", [{"start": 1}, {"scale": 0.5}, {"held_out": ("cam00", "cam01")}])
def test_a_stream_of_other_pictures_is_refused_and_stays(runs: Runs, part: dict[str, Any], frames: int) -> None:
    before = runs.full.stream.read_bytes()
    with pytest.raises(ExperimentError, match=r"another folder.*made from another capture or another part of it"):
        replace(runs.full, capture=replace(CLIP, frames=frames, **part), frames=frames).run(runs.backend)
    assert runs.full.stream.read_bytes() == before
    assert runs.full.done()


def test_a_finished_stream_of_another_configuration_is_not_scored_as_this_one(runs: Runs, tmp_path: Path) -> None:
    shutil.copytree(runs.folder / "streams", tmp_path / "streams")
    other = replace(quick(), online=replace(quick().online, iterations=1))
    run = replace(runs.full, folder=tmp_path, config=other)
    with pytest.raises(ExperimentError, match=r"another folder.*online\.iterations"):
        run.run(runs.backend)
    assert not run.result.exists()


def test_a_stream_of_more_frames_than_asked_for_is_left_alone(runs: Runs) -> None:
    before = runs.full.stream.read_bytes()
    with pytest.raises(ExperimentError, match="has 3 frames already and 2 are asked for"):
        replace(runs.full, capture=replace(CLIP, frames=2), frames=2).run(runs.backend)
    assert runs.full.stream.read_bytes() == before
    assert runs.full.done()


def test_a_first_frame_that_broke_off_is_not_done(runs: Runs, tmp_path: Path) -> None:
    first = replace(runs.first, folder=tmp_path)
    assert not first.done()
    first.stream.parent.mkdir()
    data = runs.first.stream.read_bytes()
    for length in (0, 3, len(data) // 2):
        first.stream.write_bytes(data[:length])
        assert not first.done()
    first.stream.write_bytes(data)
    assert first.done()


def test_a_first_frame_that_is_there_is_not_fitted_again(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("fitted again")

    monkeypatch.setattr("structgstream.session.struct_gstream.fit_first_frame", never)
    before = runs.first.stream.stat().st_mtime_ns
    runs.first.run(runs.backend)
    assert runs.first.stream.stat().st_mtime_ns == before


def test_scoring_alone_is_done_again_when_only_the_result_is_missing(
    runs: Runs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(runs.folder / "streams", tmp_path / "streams")
    run = replace(runs.full, folder=tmp_path)
    before = run.stream.stat().st_mtime_ns
    monkeypatch.setattr(
        "structgstream.session.struct_gstream.fit_next_frame", lambda *_, **__: pytest.fail("fitted again")
    )
    run.run(runs.backend)
    assert run.done()
    assert run.stream.stat().st_mtime_ns == before
    assert json.loads(run.result.read_text())["identity"] == json.loads(runs.full.result.read_text())["identity"]
