# SPDX-License-Identifier: Apache-2.0
"""Every peer over a moving world: its file, what the file gives back, and going on after a cut."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch

from peers.captures import Watched, moving_capture
from structgstream.codec.container.records import scan_records
from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError, StreamError
from structgstream.recorder import record
from structgstream.scene.render import render
from structgstream.session.loop import FrameReport
from structgstream_studies.peers.codec import peer_pipeline
from structgstream_studies.peers.methods import METHODS, TINY_METHODS, AnyMethod, open_peer
from structgstream_studies.peers.threedgstream import ThreeDGStream, ThreeDGStreamConfig
from tests.support.backends import quickest_backend
from tests.support.memory_captures import MemoryCapture

BACKEND = quickest_backend()
NAMES = list(TINY_METHODS)


def recorded(capture: MemoryCapture, path: Path, method: AnyMethod, *, seed: int = 5, resume: bool = False):
    return record(path, capture, peer_pipeline(method, seed=seed), BACKEND, resume=resume).reports


class Run:
    """One method's file over three frames."""

    def __init__(self, name: str, folder: Path) -> None:
        self.capture = moving_capture()
        self.watched = Watched(TINY_METHODS[name])
        self.path = folder / f"{name}.sgp"
        method: AnyMethod = cast("AnyMethod", self.watched)
        self.reports = list(recorded(self.capture, self.path, method))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    folder = tmp_path_factory.mktemp("peers")
    return {name: Run(name, folder) for name in NAMES}


def psnr_held_out(drawable, capture: MemoryCapture, index: int, path: Path) -> float:
    """Mean PSNR over the held-out cameras."""
    similarity = open_peer(path).header.similarity
    found = []
    for name in capture.rig.testing:
        image = render(drawable, similarity.camera(capture.rig[name]), BACKEND).image.clamp(0, 1)
        truth = torch.from_numpy(capture.pictures[index].images[name]) / 255.0
        found.append(-10 * float((image - truth).square().mean().log10()))
    return sum(found) / len(found)


def longer(config: ThreeDGStreamConfig) -> ThreeDGStreamConfig:
    """Long enough to see what moves."""
    return replace(config, initial=replace(config.initial, iterations=150), iterations=60, collect_from=50)


@pytest.mark.parametrize("name", NAMES)
def test_the_file_gives_back_what_was_fitted_exactly(runs: dict[str, Run], name: str) -> None:
    run = runs[name]
    reader = open_peer(run.path)
    camera = reader.header.camera(run.capture.rig["cam00"])
    frames = list(reader.scenes())
    assert len(frames) == len(run.watched.fits) == 3
    for (info, state), fit in zip(frames, run.watched.fits, strict=True):
        drawn, expected = (render(value, camera, BACKEND).image for value in (state, fit.scene))
        assert torch.equal(drawn, expected), info


@pytest.mark.parametrize("name", NAMES)
def test_any_frame_can_be_asked_for_first(runs: dict[str, Run], name: str) -> None:
    reader = open_peer(runs[name].path)
    camera = reader.header.camera(runs[name].capture.rig["cam00"])
    whole = [render(state, camera, BACKEND).image for _, state in reader.scenes()]
    ((info, state),) = reader.scenes(2)
    assert info.index == 2
    assert torch.equal(render(state, camera, BACKEND).image, whole[2])
    assert list(reader.scenes(3)) == []


@pytest.mark.parametrize("name", NAMES)
def test_reports_say_what_is_in_the_file(runs: dict[str, Run], name: str) -> None:
    run = runs[name]
    reader = open_peer(run.path)
    assert reader.complete
    assert reader.header.codec == name
    assert reader.total_bytes == run.path.stat().st_size
    for info, report in zip(reader.packets, run.reports, strict=True):
        assert isinstance(report, FrameReport)
        assert (report.index, report.kind, report.bytes) == (info.index, info.kind, info.bytes)
        assert dict(report.field_bytes) == dict(info.field_bytes)
        assert report.seconds["total"] >= report.seconds["fit"] > 0
        assert np.isfinite(report.train_psnr)
    kinds = [info.kind for info in reader.packets]
    alone = TINY_METHODS[name].stands_alone
    assert kinds == [PacketKind.KEY] + 2 * [PacketKind.KEY if alone else PacketKind.DELTA]


@pytest.mark.parametrize("name", NAMES)
def test_going_on_after_a_cut_gives_the_same_bytes(runs: dict[str, Run], name: str, tmp_path: Path) -> None:
    whole = runs[name].path.read_bytes()
    path = tmp_path / "cut.sgp"
    second = open_peer(runs[name].path).packets[1]
    path.write_bytes(whole[: second.offset + second.bytes + 7])
    assert not open_peer(path).complete
    reports = recorded(runs[name].capture, path, TINY_METHODS[name], resume=True)
    assert [report.index for report in reports] == [2]
    assert path.read_bytes() == whole


def test_going_on_with_a_whole_file_changes_nothing(runs: dict[str, Run], tmp_path: Path) -> None:
    whole = runs["3dgs"].path.read_bytes()
    path = tmp_path / "whole.sgp"
    path.write_bytes(whole)
    reports = recorded(runs["3dgs"].capture, path, TINY_METHODS["3dgs"], resume=True)
    assert list(reports) == []
    assert path.read_bytes() == whole
    last = list(scan_records(whole))[-1]
    path.write_bytes(whole[: last.offset])
    reports = recorded(runs["3dgs"].capture, path, TINY_METHODS["3dgs"], resume=True)
    assert list(reports) == []
    assert path.read_bytes() == whole


def test_another_seed_method_or_capture_is_refused(runs: dict[str, Run]) -> None:
    run = runs["3dgs"]
    with pytest.raises(ConfigError, match="seed"):
        recorded(run.capture, run.path, TINY_METHODS["3dgs"], seed=6, resume=True)
    with pytest.raises(ConfigError, match="configuration"):
        recorded(run.capture, run.path, METHODS["3dgs"], resume=True)
    with pytest.raises(ConfigError, match="method"):
        recorded(run.capture, run.path, TINY_METHODS["scaffold-gs"], resume=True)
    held = replace(run.capture, rig=run.capture.rig.with_held_out(frozenset({"cam01"})))
    with pytest.raises(ConfigError, match="cameras"):
        recorded(held, run.path, TINY_METHODS["3dgs"], resume=True)


def test_following_is_better_than_holding_frame_zero(tmp_path: Path) -> None:
    method, capture = ThreeDGStream(longer(TINY_METHODS["3dgstream"].config)), moving_capture(3, speed=0.06)
    path = tmp_path / "followed.sgp"
    for _ in recorded(capture, path, method, seed=0):
        pass
    states = [state for _, state in open_peer(path).scenes()]
    assert psnr_held_out(states[2], capture, 2, path) > psnr_held_out(states[0], capture, 2, path) + 1.5


@pytest.mark.parametrize("name", NAMES)
def test_every_frame_is_better_than_grey(runs: dict[str, Run], name: str) -> None:
    run = runs[name]
    for info, state in open_peer(run.path).scenes():
        truth = run.capture.pictures[info.index].images["cam00"] / 255.0
        grey = -10 * np.log10(np.mean((truth - truth.mean()) ** 2))
        assert psnr_held_out(state, run.capture, info.index, run.path) > grey


def test_additions_live_for_one_frame(runs: dict[str, Run]) -> None:
    run = runs["3dgstream"]
    first, second, third = (fit.scene for fit in run.watched.fits)
    assert len(first.added) == 0
    assert len(second.added) > 0
    assert len(second.base) == len(third.base) == len(first.base)
    decoded = [state for _, state in open_peer(run.path).scenes()]
    assert torch.equal(decoded[2].base.means, third.base.means)
    assert len(decoded[2]) == len(third.base) + len(third.added)


def test_sizes_are_those_of_the_cache(runs: dict[str, Run]) -> None:
    run = runs["3dgstream"]
    grid = TINY_METHODS["3dgstream"].config.grid
    sizes: dict[str, int] = {**run.reports[1].field_bytes}
    assert sizes["grid"] == 2 * grid.total_rows * grid.features + 4 + 4 + 8
    assert sizes["network"] == 2 * grid.weights + 4 + 7 + 4
    added = len(run.watched.fits[1].scene.added)
    assert sizes["added_sh"] == 4 * 9 * added + 4 + 8 + 12


def test_a_file_of_an_unknown_method_or_grid_is_refused(runs: dict[str, Run], tmp_path: Path) -> None:
    from structgstream_studies.peers.methods import decoder_of

    header = open_peer(runs["3dgstream"].path).header
    with pytest.raises(StreamError, match="nobody"):
        decoder_of(replace(header, codec="nobody"))
    for change in ({"levels": 40}, {"features": 0}, {"outputs": 9}, {"growth": 0.5}, {"base": 2.5}, {"new": 1}):
        config = {**header.config, "grid": {**header.config["grid"], **change}}
        with pytest.raises(StreamError, match="configuration"):
            decoder_of(replace(header, config=config))
