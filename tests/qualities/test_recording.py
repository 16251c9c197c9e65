# SPDX-License-Identifier: Apache-2.0
"""Several qualities of the same frames: each has the bytes of a run of its own, whenever the process is killed."""

import json
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.codec.reader import open_stream
from structgstream.codec.segments.quality_list import read_list
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest, write_archive
from structgstream.data.live.resume_cache import resume_folder
from structgstream.errors import ConfigError, StorageError
from structgstream.evaluation.run_log import read_log
from structgstream.frames import MultiViewFrame
from structgstream.qualities import QualityReport, configured, qualities_in, record_qualities
from structgstream.recorder import Run, RunMetrics, record, segments_at, segments_folder
from structgstream.session import loop, struct_gstream
from structgstream.session.loop import Session
from structgstream.session.presets import StreamConfig
from structgstream.session.struct_gstream import stream_pipeline
from tests.support.backends import quickest_backend
from tests.support.moving_block import PERIODS, POINTS, RIG, LiveBlock, filmed
from tests.support.small_presets import QUICK

QUALITIES = qualities_in(["high=2", "low=-2"])
NAMES = ("low", "high")
FRAMES = 5


@dataclass
class Recorded:
    """A recording that counts how often each frame is read."""

    count: int = FRAMES
    rig: CameraRig = RIG
    fps: float = 30.0
    name: str = "now"
    points: np.ndarray = field(default_factory=POINTS.copy)
    read: list[int] = field(default_factory=list)

    def __len__(self) -> int:
        return self.count

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for index in range(start, self.count):
            self.read.append(index)
            yield MultiViewFrame(index, index / 4, filmed(index))


def begun(
    folder: Path,
    source: Recorded | LiveBlock,
    config: StreamConfig = QUICK,
    *,
    resume: bool = False,
    metrics: RunMetrics | None = None,
) -> Run:
    stores = {name: segments_folder(folder / name, may_exist=True) for name in NAMES}
    storages = {name: segments_at(store) for name, store in stores.items()}
    return record_qualities(
        folder, source, config, QUALITIES, quickest_backend(), storages=storages, resume=resume, metrics=metrics
    )


def archived(folder: Path, name: str) -> bytes:
    path = folder.with_name(f"{folder.name}-{name}.sgs")
    write_archive(FolderStore(folder / name), path)
    return path.read_bytes()


def alone(path: Path, name: str, config: StreamConfig = QUICK) -> bytes:
    """The bytes of a run with one quality."""
    (quality,) = (one for one in QUALITIES if one.name == name)
    pipeline = stream_pipeline(configured(config, quality))
    list(record(path, Recorded(), pipeline, quickest_backend()).reports)
    return path.read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five frames in two qualities, of a recording."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    list(begun(folder, Recorded()).reports)
    return folder


def test_each_quality_has_the_bytes_of_a_run_of_its_own(whole: Path, tmp_path: Path) -> None:
    found = {name: archived(whole, name) for name in NAMES}
    for name in NAMES:
        assert found[name] == alone(tmp_path / f"{name}.sgs", name)
    assert len(found["low"]) < len(found["high"])


def counted(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often pictures are prepared and first frames are fitted."""
    counts = Counter[str]()

    def counting(name: str, original: Any) -> Any:
        def call(*args: Any, **further: Any) -> Any:
            counts[name] += 1
            return original(*args, **further)

        return call

    for name in ("fit_first_frame", "preprocess"):
        monkeypatch.setattr(struct_gstream, name, counting(name, getattr(struct_gstream, name)))
    return counts


def test_a_period_that_begins_from_points_is_fitted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = torch.from_numpy(POINTS)
    monkeypatch.setattr(loop, "initial_points_of", lambda *args, **further: points)
    config = replace(PERIODS, period=replace(PERIODS.period, start="points"))
    found = alone(tmp_path / "high.sgs", "high", config)
    counts = counted(monkeypatch)
    list(begun(tmp_path / "out", Recorded(), config).reports)
    assert counts == {"fit_first_frame": 2, "preprocess": FRAMES}
    assert archived(tmp_path / "out", "high") == found


def test_each_frame_is_read_and_prepared_once_and_frame_0_fitted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = counted(monkeypatch)
    source = Recorded(count=3)
    reports = list(begun(tmp_path / "out", source).reports)
    assert source.read == [0, 1, 2, 1, 2], "once more to denoise frame 0"
    assert counts == {"fit_first_frame": 1, "preprocess": 3}
    assert [(one.quality, one.report.index, one.whole) for one in reports] == [
        (name, index, name == "high") for index in range(3) for name in NAMES
    ]
    first, second = (one.report.seconds for one in reports[:2])
    assert "rasterise" in first
    assert "rasterise" not in second, "the seconds of the fit are reported once"


def test_the_list_the_logs_and_the_metrics(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    metrics = RunMetrics(folder, fps=30.0, qualities=NAMES)
    run, source = begun(folder, Recorded(count=7), metrics=metrics), []
    expected = read_list(folder)
    assert [(one.name, one.manifest) for one in expected] == [(name, f"{name}/manifest.json") for name in NAMES]
    assert [one.bits_per_second for one in expected] == [0.5e6, 8e6], "before anything is known"
    assert not (folder / "low" / "manifest.json").exists()
    for one in run.reports:
        source.append(one)
        if one.whole and one.report.index < 5:
            assert read_list(folder) == expected
    measured = read_list(folder)
    sizes = {name: [one.report.bytes for one in source if one.quality == name] for name in NAMES}
    assert [one.bits_per_second for one in measured] == [round(8 * sum(sizes[name][1:]) / 1.5) for name in NAMES]
    values = json.loads((tmp_path / "out.metrics.json").read_text())
    assert values["frames"] == 7
    assert {name: one["bytes"] for name, one in values["qualities"].items()} == {n: sum(s) for n, s in sizes.items()}
    assert values["bytes"] == sum(map(sum, sizes.values()))
    log = read_log(folder)
    assert [*log] == [*range(7)]
    for name in NAMES:
        own = read_log(folder / name)
        for index in range(7):
            line = log[index]["qualities"][name]
            assert line["bytes"] == own[index]["bytes"] == sizes[name][index]
            assert line["train_psnr"] == own[index]["train_psnr"]
            assert line["total_seconds"] == own[index]["total_seconds"] <= log[index]["total_seconds"]


def left_by_a_kill(run: Run, folder: Path, *, after: tuple[str, int]) -> None:
    """What is on the disk after a kill -9 when a quality has just stored a frame: copied, as nothing is closed."""
    for one in run.reports:
        if (one.quality, one.report.index) == after:
            copy = folder.with_name("killed")
            shutil.copytree(folder, copy / "out")
            if resume_folder(folder).exists():
                shutil.copytree(resume_folder(folder), resume_folder(copy / "out"))
            run.reports.close()
            shutil.rmtree(folder)
            shutil.rmtree(resume_folder(folder), ignore_errors=True)
            for path in copy.iterdir():
                path.rename(folder.parent / path.name)
            return


@pytest.mark.parametrize("after", [("low", 0), ("high", 0), ("low", 2), ("high", 2), ("low", 4)])
@pytest.mark.parametrize("live", [False, True])
def test_a_run_that_was_killed_between_two_qualities_goes_on_to_the_same_bytes(
    whole: Path, tmp_path: Path, after: tuple[str, int], live: bool
) -> None:
    folder = tmp_path / "out"
    left_by_a_kill(begun(folder, LiveBlock(folder, FRAMES) if live else Recorded()), folder, after=after)
    source = LiveBlock(folder, FRAMES, resume=True) if live else Recorded()
    run = begun(folder, source, resume=True)
    quality, last = after
    lacking = quality == "low"
    assert run.done == last + 1 - lacking
    reports = [(one.quality, one.report.index) for one in run.reports]
    assert reports == [("high", last)] * lacking + [(n, i) for i in range(last + 1, FRAMES) for n in NAMES]
    if isinstance(source, LiveBlock):
        assert [*source.filmed] == [*range(last + 1, FRAMES)], "what was filmed before is kept"
    for name in NAMES:
        assert archived(folder, name) == archived(whole, name)
        assert read_manifest(FolderStore(folder / name)).edge.frame == FRAMES - 1
    log = read_log(folder)
    assert [*log] == [*range(FRAMES)]
    assert all([*entry["qualities"]] == list(NAMES) for entry in log.values())


@pytest.fixture(scope="module")
def periods_alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of a run with one quality, two periods each."""
    folder = tmp_path_factory.mktemp("alone")
    return {name: alone(folder / f"{name}.sgs", name, PERIODS) for name in NAMES}


@pytest.mark.parametrize("after", [("low", 2), ("low", 3), ("high", 3)])
def test_periods_of_a_live_run_that_was_killed(
    periods_alone: dict[str, bytes], tmp_path: Path, after: tuple[str, int]
) -> None:
    """At the frame that begins another one in one quality and not yet in the other."""
    folder = tmp_path / "out"
    left_by_a_kill(begun(folder, LiveBlock(folder, FRAMES), PERIODS), folder, after=after)
    list(begun(folder, LiveBlock(folder, FRAMES, resume=True), PERIODS, resume=True).reports)
    for name in NAMES:
        with open_stream(folder / name) as reader:
            assert [period.first_frame for period in reader.periods] == [0, 3]
        assert archived(folder, name) == periods_alone[name]


def test_what_is_complete_is_left_as_it_is(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    shutil.copytree(whole, folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    run = begun(folder, Recorded(), resume=True)
    assert (run.done, list(run.reports)) == (FRAMES, [])
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_run_that_is_left_closes_all_and_keeps_the_rates(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    run = begun(folder, Recorded())
    seen: list[QualityReport] = [*islice(run.reports, 4)]
    run.reports.close()
    assert [one.whole for one in seen] == [False, True] * 2
    assert not any(read_manifest(FolderStore(folder / name)).live for name in NAMES)
    rates = read_list(folder)
    again = begun(folder, Recorded(), resume=True)
    assert read_list(folder) == rates
    assert rates[0].bits_per_second != 0.5e6
    list(again.reports)
    assert [len(open_stream(folder / name)) for name in NAMES] == [FRAMES] * 2


def test_one_that_cannot_be_written_ends_all_and_all_go_on(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, write, written = tmp_path / "out", Session._write, []

    def full(self: Any, packet: Any, task: Any) -> int:
        written.append(packet.index)
        if len(written) == 4:
            raise StorageError("no room")
        return write(self, packet, task)

    with monkeypatch.context() as patch:
        patch.setattr(Session, "_write", full)
        with pytest.raises(StorageError, match="no room"):
            list(begun(folder, Recorded()).reports)
    assert [read_manifest(FolderStore(folder / name)).edge.frame for name in NAMES] == [1, 0]
    assert not any(read_manifest(FolderStore(folder / name)).live for name in NAMES)
    list(begun(folder, Recorded(), resume=True).reports)
    assert all(archived(folder, name) == archived(whole, name) for name in NAMES)


def test_another_configuration_is_refused_before_anything_is_changed(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    shutil.copytree(whole, folder)
    with pytest.raises(ConfigError, match="online.iterations"):
        begun(folder, Recorded(), replace(QUICK, online=replace(QUICK.online, iterations=3)), resume=True)
    assert archived(folder, "low") == archived(whole, "low")
