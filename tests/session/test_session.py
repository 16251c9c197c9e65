# SPDX-License-Identifier: Apache-2.0
import errno
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.codec.container.records import scan_records
from structgstream.codec.packets import Packet
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.sinks import FileSink, MemorySink
from structgstream.errors import CalibrationError, CaptureError, ConfigError, StorageError
from structgstream.evaluation.run_log import log_entry
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import reference_backend
from structgstream.scene.state import PAPER_DYNAMIC, state_of
from structgstream.session import struct_gstream as method
from structgstream.session.frame_report import FrameReport
from structgstream.session.loop import Session, frame_seed
from structgstream.session.presets import PRESETS, StreamConfig
from structgstream.session.struct_gstream import stream_pipeline
from structgstream.training.result import FitResult
from tests.support.memory_captures import MemoryCapture
from tests.support.sessions import resume_in, run_session
from tests.support.small_presets import TINY_RIG
from tests.support.streams import moved, same, small_scene
from tests.support.worlds import moving_world

WORLD = moving_world(1)
POINTS = np.random.default_rng(0).normal(size=(60, 3)) * 0.4


def capture(frames: int = 5) -> MemoryCapture:
    """Three cameras, the first held out; the same picture at every time."""
    names = [*WORLD.rig][:3]
    rig = CameraRig({name: WORLD.rig[name] for name in names}, frozenset(names[:1]))
    images = {name: WORLD.frames[0].images[name] for name in names}
    return MemoryCapture(rig, [MultiViewFrame(i, i / 30.0, images) for i in range(frames)], points=POINTS)


@pytest.fixture
def quick_fits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Fits that take no time and depend on seed and start as real ones do; the list fills with the seeds used."""
    seeds: list[int] = []

    def first(frame, rig, points, *, config, backend, seed, on_step, before=None, roving=()):
        seeds.append(seed)
        return FitResult(small_scene(seed=seed % 1000), 1, 20.0, grown=4, removed=3)

    def following(scene, frame, rig, *, config, backend, seed, on_step, **options):
        seeds.append(seed)
        return FitResult(moved(scene, seed % 7), 1, 21.0, spawned=2, pruned=1, seconds={"render": 0.5})

    monkeypatch.setattr(method, "fit_first_frame", first)
    monkeypatch.setattr(method, "fit_next_frame", following)
    return seeds


def run(source: MemoryCapture, sink, *, config: StreamConfig = TINY_RIG, **options: Any) -> list[FrameReport]:
    return run_session(source, sink, config, **options)


def uninterrupted(frames: int = 5, config: StreamConfig = TINY_RIG) -> bytes:
    sink = MemorySink()
    run(capture(frames), sink, config=config)
    return sink.data


def test_every_frame_is_reported_and_readable(quick_fits: list[int]) -> None:
    sink = MemorySink()
    source = replace(capture(), fps=2.0)
    reports = run(source, sink)
    reader = StreamReader(sink.data)
    assert reader.complete
    assert [(r.index, r.pts_seconds, r.kind, r.bytes) for r in reports] == [
        (info.index, info.pts_seconds, info.kind, info.bytes) for info in reader.packets
    ]
    assert [r.kind.name for r in reports] == ["KEY", "DELTA", "KEY", "DELTA", "KEY"]
    assert [(r.train_psnr, r.spawned, r.pruned, r.anchors) for r in reports[:2]] == [(20.0, 0, 0, 3), (21.0, 2, 1, 3)]
    assert [(r.grown, r.removed) for r in reports[:2]] == [(4, 3), (0, 0)]
    assert [log_entry(r)["removed"] for r in reports[:2]] == [3, 0]
    assert [r.free for r in reports] == [len(scene.free) for _, scene in reader.scenes()]
    assert all({"read", "fit", "encode", "write", "total"} <= r.seconds.keys() for r in reports)
    assert reader.header.rig.held_out == source.rig.held_out
    assert reader.header.metadata == {"capture": "world"}
    assert reader.header.config["seed"] == 0


def test_each_frame_starts_from_what_a_reader_sees(quick_fits: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    started_from = []

    def following(scene, frame, rig, *, config, backend, seed, on_step, **options):
        """A trainer that touches a static field, which no packet carries."""
        started_from.append(scene)
        fitted = moved(scene, frame.index)
        anchors = replace(fitted.anchors, features=fitted.anchors.features + 1)
        return FitResult(replace(fitted, anchors=anchors), 1, 21.0)

    monkeypatch.setattr(method, "fit_next_frame", following)
    sink = MemorySink()
    run(capture(), sink)
    seen = [scene for _, scene in StreamReader(sink.data).scenes()]
    assert all(same(a, b) for a, b in zip(started_from, seen[:-1], strict=True))


def test_every_frame_has_a_seed_of_its_own(quick_fits: list[int]) -> None:
    uninterrupted()
    assert quick_fits == [frame_seed(0, i) for i in range(5)] == [0, 1, 2, 3, 4]
    assert frame_seed(2, 7) == 2_000_013


def in_unit_range(source: MemoryCapture) -> list[MultiViewFrame]:
    return [replace(frame, images={n: i / 255 for n, i in frame.images.items()}) for frame in source.pictures]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"fps": -30.0}, "Frames a second must be positive, got -30"),
        ({"points": np.zeros((60, 6))}, r"points of world have shape \(60, 6\); expected \[P, 3\]"),
        ({"pictures": capture().pictures[1:]}, "world gives frame 1 where frame 0 belongs"),
        ({"pictures": in_unit_range(capture())}, "float64 .*; expected a numpy array of uint8"),
    ],
    ids=["rate", "points", "numbers", "pictures"],
)
def test_a_source_that_contradicts_the_protocol_is_refused(
    quick_fits: list[int], wrong: dict[str, Any], words: str
) -> None:
    with pytest.raises((CaptureError, ConfigError), match=words):
        run(replace(capture(), **wrong), MemorySink())


def test_a_near_plane_behind_the_scene_is_named(quick_fits: list[int]) -> None:
    source = capture()
    rig = source.rig.mapped({name: replace(camera, near=1e4) for name, camera in source.rig.cameras.items()})
    with pytest.raises(CalibrationError, match="near plane lies at .* times the rig's radius, by default at 0.12"):
        run(replace(source, rig=rig), MemorySink(), config=PRESETS["tiny"])


def test_resuming_gives_the_bytes_of_an_uninterrupted_run(quick_fits: list[int], tmp_path: Path) -> None:
    whole = uninterrupted()
    path = tmp_path / "a.sgs"
    ends = [record.end for record in scan_records(whole)]
    for cut in sorted({0, 3, len(whole), *ends, *(end - 1 for end in ends), *range(1, len(whole), 397)}):
        path.write_bytes(whole[:cut])
        quick_fits.clear()
        sink, resumed = FileSink.resume(path)
        reports = run(capture(), sink, resumed=resumed)
        assert path.read_bytes() == whole
        assert len(reports) == len(quick_fits) == 5 - (0 if resumed is None else len(resumed))


def test_a_longer_part_of_the_capture_continues_a_complete_file(quick_fits: list[int], tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    run(capture(2), FileSink(path))
    sink, resumed = FileSink.resume(path)
    assert [r.index for r in run(capture(5), sink, resumed=resumed)] == [2, 3, 4]
    assert path.read_bytes() == uninterrupted()


def test_another_run_is_not_continued(quick_fits: list[int], tmp_path: Path) -> None:
    """What makes it another: ``test_resuming``."""
    path = tmp_path / "a.sgs"
    run(capture(), FileSink(path))
    before = path.read_bytes()
    sink, resumed = FileSink.resume(path)
    with pytest.raises(ConfigError, match="another capture or another part of it: capture, start differ"):
        run(replace(capture(), name="hall"), sink, resumed=resumed, metadata={"start": 5})
    sink.close()
    assert path.read_bytes() == before


def interrupted_at(frame: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while ``frame`` is fitted."""
    fit = method.fit_next_frame

    def following(scene, at, rig, **options):
        if at.index == frame:
            raise KeyboardInterrupt
        return fit(scene, at, rig, **options)

    monkeypatch.setattr(method, "fit_next_frame", following)


def test_ctrl_c_leaves_a_complete_file(quick_fits: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupted_at(3, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        run(capture(), FileSink(tmp_path / "a.sgs"))
    reader = open_stream(tmp_path / "a.sgs")
    assert (len(reader), reader.complete) == (3, True)


def test_a_consumer_that_stops_leaves_a_complete_file(quick_fits: list[int]) -> None:
    sink = MemorySink()
    reports = Session(capture(), sink, stream_pipeline(TINY_RIG), reference_backend()).run()
    next(reports)
    reports.close()  # type: ignore[attr-defined]
    reader = StreamReader(sink.data)
    assert (len(reader), reader.complete) == (1, True)


class Stuck(MemorySink):
    """A sink that fails at its third packet, and at closing."""

    def write(self, packet: Packet) -> int:
        if packet.index == 2:
            raise StorageError("no room for packet 2")
        return super().write(packet)

    def close(self) -> None:
        raise StorageError("no room for the index")


def test_closing_does_not_hide_what_went_wrong_first(quick_fits: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StorageError, match="no room for packet 2"):
        run(capture(), Stuck())
    with pytest.raises(StorageError, match="no room for the index"):
        run(capture(2), Stuck())
    interrupted_at(1, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        run(capture(), Stuck())


def test_a_failure_in_the_first_frame_leaves_the_old_file(
    quick_fits: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.sgs"
    path.write_text("an older result")

    def first(*_: object, **__: object) -> FitResult:
        raise OSError(errno.EIO, "the capture went away")

    monkeypatch.setattr(method, "fit_first_frame", first)
    with pytest.raises(OSError, match="went away"):
        run(capture(), FileSink(path, overwrite=True))
    assert path.read_text() == "an older result"


def test_nothing_of_the_machine_or_the_moment_is_in_a_stream(quick_fits: list[int]) -> None:
    header = StreamReader(uninterrupted()).header
    assert header.metadata.keys() == {"capture"}
    names = {"denoising", "environment", "initial", "online", "points", "key_interval_seconds", "rate", "codec", "seed"}
    assert header.config.keys() == names


def test_the_real_fit_resumes_exactly_and_keeps_static_fields(tmp_path: Path) -> None:
    world = moving_world(3, emerges_at=1)
    source = MemoryCapture(world.rig, world.frames, points=POINTS)
    config = replace(
        TINY_RIG,
        initial=replace(TINY_RIG.initial, iterations=12, schedule_iterations=12, coarse_iterations=4, voxel_size=0.1),
        online=replace(TINY_RIG.online, iterations=4, patching=replace(TINY_RIG.online.patching, iteration=2)),
    )
    whole = MemorySink()
    run(source, whole, config=config)
    reader = StreamReader(whole.data)
    states = [state_of(scene) for _, scene in reader.scenes()]
    for name, value in states[0].items():
        if name not in PAPER_DYNAMIC:
            assert torch.equal(value, states[2][name]), name
    assert not torch.equal(states[0]["anchor_positions"], states[2]["anchor_positions"])
    path = tmp_path / "a.sgs"
    for cut in (reader.packets[1].offset, reader.packets[2].offset + 99):
        resume_in(path, whole.data[:cut], partial(run, source, config=config))
        assert path.read_bytes() == whole.data
