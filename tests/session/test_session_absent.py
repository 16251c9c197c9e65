# SPDX-License-Identifier: Apache-2.0
"""Streams of captures in which cameras are absent from frames, and whose masks leave pixels out."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.cli.progress import summary
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.sinks import FileSink
from structgstream.data.source import FrameSource, section
from structgstream.errors import CaptureError
from structgstream.evaluation.evaluate import evaluate
from structgstream.evaluation.optional_metrics import OF_WHOLE_PICTURES
from structgstream.evaluation.plots import write_plots
from structgstream.evaluation.report import as_json
from structgstream.evaluation.run_log import log_entry
from structgstream.frames import MultiViewFrame
from structgstream.scene.scene import Scene
from structgstream.session.frame_report import FrameReport
from structgstream.session.presets import PRESETS, StreamConfig
from structgstream.training.online.config import SpawnRules
from tests.support.backends import quickest_backend
from tests.support.memory_captures import MemoryCapture
from tests.support.sessions import run_session
from tests.support.small_presets import TINY_RIG
from tests.support.varied import varied
from tests.support.worlds import World, moving_world

COMPACT = PRESETS["compact"]
INITIAL = replace(TINY_RIG.initial, camera_color=True, voxel_size=0.05)
CONFIG = replace(
    COMPACT,
    initial=replace(INITIAL, iterations=40, schedule_iterations=40, coarse_iterations=20),
    online=replace(
        COMPACT.online,
        iterations=8,
        patching=replace(COMPACT.online.patching, iteration=4),
        motion=replace(COMPACT.online.motion, picture_scale=0.5),
        spawn=varied(COMPACT.online.spawn, RULES=SpawnRules(max_missing_share=1.0)),
    ),
)
"""Everything that the preset compact does with pictures, in seconds."""


@pytest.fixture(scope="module")
def world() -> World:
    return moving_world(4, speed=0.08, movers=20, width=96, height=64, emerges_at=2)


def capture(world: World, lacking: Mapping[int, str | tuple[str, ...]]) -> MemoryCapture:
    """The world without some cameras' pictures, by frame."""
    frames = []
    for frame in world.frames:
        without = lacking.get(frame.index, ())
        without = (without,) if isinstance(without, str) else without
        frames.append(replace(frame, images={name: i for name, i in frame.images.items() if name not in without}))
    return MemoryCapture(world.rig, frames, points=world.scene.anchors.positions.numpy())


def run(source: FrameSource, path: Path, *, config: StreamConfig = CONFIG, resume: bool = False) -> list[FrameReport]:
    sink, resumed = FileSink.resume(path) if resume else (FileSink(path), None)
    return run_session(source, sink, config, resumed=resumed)


def begun(whole: Path, path: Path, *, frames: int) -> Path:
    """A file that ends after as many frames of another."""
    last = open_stream(whole).packets[frames - 1]
    path.write_bytes(whole.read_bytes()[: last.offset + last.bytes])
    return path


def decoded(path: Path) -> list[Scene]:
    with open_stream(path) as reader:
        assert isinstance(reader, StreamReader)
        return [reader.scene(index) for index in range(len(reader))]


LACKING = {
    "a camera that dies": {1: "cam03", 2: "cam03", 3: "cam03"},
    "absent from frame 0, and the held-out one": {0: "cam01", 1: "cam00"},
}
IN_TURN = {1: "cam02", 2: ("cam02", "cam04")}


@pytest.fixture(scope="module")
def in_turn(world: World, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[FrameReport]]:
    """A stream from which one camera is absent, then two; all return."""
    path = tmp_path_factory.mktemp("absent") / "a.sgs"
    return path, run(capture(world, IN_TURN), path)


def check_absent(reports: list[FrameReport], lacking: Mapping[int, str | tuple[str, ...]]) -> None:
    assert len(reports) == 4
    for report in reports:
        names = lacking.get(report.index, ())
        assert report.absent == ((names,) if isinstance(names, str) else names)
        assert report.train_psnr > 15


@pytest.mark.parametrize("case", LACKING)
def test_training_goes_on_with_the_cameras_that_are_there(world: World, tmp_path: Path, case: str) -> None:
    check_absent(run(capture(world, LACKING[case]), tmp_path / "a.sgs"), LACKING[case])


def test_a_resumed_stream_is_the_uninterrupted_one_also_around_absences(
    world: World, in_turn: tuple[Path, list[FrameReport]], tmp_path: Path
) -> None:
    """A camera that returns is compared with nothing older than the frame before, which alone is read again."""
    whole, reports = in_turn
    check_absent(reports, IN_TURN)
    for count in (2, 3):
        path = begun(whole, tmp_path / f"{count}.sgs", frames=count)
        run(capture(world, IN_TURN), path, resume=True)
        assert path.read_bytes() == whole.read_bytes()


def test_a_frame_that_too_few_cameras_have_is_refused_by_number(world: World, tmp_path: Path) -> None:
    source = capture(world, {2: ("cam01", "cam02", "cam04")})
    with pytest.raises(
        CaptureError, match="Frame 2 of world has pictures of cam03 of its 4 training cameras; at least 2"
    ):
        run(source, tmp_path / "a.sgs")
    assert len(decoded(tmp_path / "a.sgs")) == 2  # whole frames stay


def test_absences_are_in_the_line_and_in_the_log(in_turn: tuple[Path, list[FrameReport]]) -> None:
    _, reports = in_turn
    assert ["absent" in log_entry(report) for report in reports] == [False, True, True, False]
    assert log_entry(reports[2])["absent"] == ("cam02", "cam04")
    assert "absent" not in summary(reports[0], 4)
    assert summary(reports[1], 4).endswith("[absent: cam02]")
    assert summary(reports[2], 4).endswith("[2 cameras absent: cam02, cam04]")


def test_colors_stay_with_their_cameras(world: World, tmp_path: Path) -> None:
    """One camera is darker than the others; another that is absent does not shift its row."""
    frames = [
        replace(frame, images={**frame.images, "cam03": (frame.images["cam03"] * 0.6).astype(np.uint8)})
        for frame in capture(world, {0: "cam01"}).pictures
    ]
    source = MemoryCapture(world.rig, frames[:1], points=world.scene.anchors.positions.numpy())
    longer = replace(CONFIG, initial=replace(CONFIG.initial, iterations=300, schedule_iterations=300))
    run(source, tmp_path / "a.sgs", config=longer)
    gains = decoded(tmp_path / "a.sgs")[0].camera_color.gains.mean(1)
    assert gains.shape == (4,)
    assert int(gains.argmin()) == world.rig.training.index("cam03")
    assert abs(float(gains[0]) - float(gains[[1, 3]].mean())) < 0.15  # about neutral


@pytest.fixture(scope="module")
def plain(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stream from which nothing is absent."""
    path = tmp_path_factory.mktemp("plain") / "a.sgs"
    run(capture(world, {}), path)
    return path


def masked(world: World, masks: Mapping[str, np.ndarray], garbage: int | None) -> MemoryCapture:
    """The world with masks, and with noise or nothing in what they leave out."""
    frames: list[MultiViewFrame] = []
    for frame in world.frames:
        images = dict(frame.images)
        if garbage is not None:
            rng = np.random.default_rng(garbage + frame.index)
            for name, mask in masks.items():
                noise = rng.integers(0, 255, images[name].shape, dtype=np.uint8)
                images[name] = np.where(mask[..., None], images[name], noise)
        frames.append(replace(frame, images=images, masks=dict(masks)))
    return MemoryCapture(world.rig, frames, points=world.scene.anchors.positions.numpy())


def test_what_masks_leave_out_has_no_influence_on_a_single_byte(world: World, tmp_path: Path) -> None:
    """Loss, dynamic masks, flow, spawning, baseline and colours, with noise that flickers in every masked pixel."""
    rng = np.random.default_rng(5)
    masks = {name: np.ones((64, 96), bool) for name in ("cam01", "cam02", "cam03")}
    masks["cam01"][:, 60:] = False
    masks["cam02"][20:45, 30:70] = False
    masks["cam03"] = rng.random((64, 96)) > 0.02
    streams = []
    for number, garbage in enumerate((None, 1)):
        reports = run(section(masked(world, masks, garbage), frames=3), tmp_path / f"{number}.sgs")
        streams.append((tmp_path / f"{number}.sgs").read_bytes())
        assert all(report.moving > 0 for report in reports[1:])
    assert streams[0] == streams[1]


def test_a_held_out_camera_is_scored_where_it_has_pictures(world: World, plain: Path, tmp_path: Path) -> None:
    lacking = capture(world, {0: "cam00", 2: "cam00"})
    with open_stream(plain) as reader:
        report = evaluate(reader, lacking, backend=quickest_backend())
    assert report.stream["absent_frames"] == {"cam00": 2}
    assert [frame.mean is None for frame in report.frames] == [True, False, True, False]
    scores = [frame.cameras["cam00"] for frame in (report.frames[1], report.frames[3])]
    assert report.mean.psnr == pytest.approx(np.mean([score.psnr for score in scores]))
    assert scores[1].flicker is None  # no frame before it to compare with
    content = as_json(report)
    assert content["frames"][0]["psnr"] is None
    json.dumps(content, allow_nan=False)
    write_plots(tmp_path / "plot.png", report, title="a")
    nowhere = capture(world, dict.fromkeys(range(4), "cam00"))
    with (
        open_stream(plain) as reader,
        pytest.raises(CaptureError, match="No frame of the capture world has a picture of"),
    ):
        evaluate(reader, nowhere, backend=quickest_backend())


def test_scores_are_of_the_pixels_that_count(world: World, plain: Path) -> None:
    """Noise in masked pixels changes no score, and without the mask every one."""
    masks = {"cam00": np.broadcast_to(np.arange(96) >= 30, (64, 96)).copy()}
    found = []
    for garbage, with_masks in ((None, True), (1, True), (1, False)):
        source = masked(world, masks, garbage)
        source.pictures = [replace(frame, masks=masks if with_masks else {}) for frame in source.pictures]
        with open_stream(plain) as reader:
            found.append(evaluate(reader, source, backend=quickest_backend()))
    clean, noisy, whole = (
        {name: value for name, value in vars(report.mean).items() if name != "render_seconds"} for report in found
    )
    assert clean == noisy
    assert noisy["psnr"] > whole["psnr"] + 3
    assert noisy["ssim"] > whole["ssim"] + 0.05
    assert noisy["ms_ssim"] is None
    reasons = found[0].stream["not_available"]
    assert "masks leave out pixels of cam00" in reasons["temporal_flip"]
    assert all(name in reasons for name in OF_WHOLE_PICTURES)
    assert found[0].stream["masked_share"] == {"cam00": pytest.approx(30 / 96)}


def test_a_scene_that_no_picture_shows_is_held_and_found_again(world: World, tmp_path: Path) -> None:
    """All cameras black in frame 2: the scene stays, and frame 3 is compared with frame 1, in a resumed stream too."""
    source = capture(world, {})
    source.pictures = [
        replace(frame, images={name: np.zeros_like(image) for name, image in frame.images.items()})
        if frame.index == 2
        else frame
        for frame in source.pictures
    ]
    whole = tmp_path / "whole.sgs"
    # Nothing is carried along: in this small world that would be all that stands still.
    motion = replace(CONFIG.online.motion, occluded_share=0.0)
    config = replace(CONFIG, online=replace(CONFIG.online, motion=motion))
    reports = run(source, whole, config=config)
    assert [dict(report.counts).get("held", 0) for report in reports] == [0, 0, 1, 0]
    assert set(world.rig.training) <= set(reports[2].absent)
    assert reports[2].bytes < 100 < reports[3].bytes
    assert "the scene is held" in summary(reports[2], 4)
    counts = dict(reports[3].counts)
    assert counts["scene cuts"] == 0, "it is compared with frame 1, not with black pictures"
    assert counts["displaced"] > 0
    assert 0 < reports[3].moving < reports[3].anchors
    scenes = decoded(whole)
    assert torch.equal(scenes[2].anchors.positions, scenes[1].anchors.positions)
    assert not torch.equal(scenes[3].anchors.positions, scenes[2].anchors.positions)
    for done in (2, 3):
        path = begun(whole, tmp_path / f"begun{done}.sgs", frames=done)
        run(source, path, config=config, resume=True)
        assert path.read_bytes() == whole.read_bytes()
