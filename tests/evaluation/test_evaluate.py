# SPDX-License-Identifier: Apache-2.0
"""Evaluation of streams whose content is known: the world's own scenes, whole or spoilt."""

import mmap
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.cameras import Similarity
from structgstream.codec.contents import PacketInfo
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import MemorySink
from structgstream.data.images import ImageSource
from structgstream.data.source import section
from structgstream.errors import CaptureError
from structgstream.evaluation.evaluate import evaluate
from structgstream.evaluation.metrics import PSNR_OF_EQUALS
from structgstream.evaluation.recording import numbers_of
from structgstream.evaluation.report import as_json
from structgstream.frames import MultiViewFrame
from structgstream.gaussians import Gaussians
from structgstream.memory import resident_bytes
from structgstream.scene.scene import Scene
from tests.support.backends import quickest_backend
from tests.support.memory_captures import MemoryCapture
from tests.support.reports import mean_of
from tests.support.streams import header_for, write_stream
from tests.support.worlds import World, emerging_ball, moving_world, rendered

SPEED = 0.03


def scenes_of(world: World, *, follow: bool = True) -> list[Scene]:
    """Every frame's own scene, or the first one for ever."""
    anchors = world.scene.anchors
    shifts = [torch.tensor([SPEED * t * follow, 0.0, 0.0]) for t in range(len(world.frames))]
    return [replace(world.scene, anchors=replace(anchors, positions=anchors.positions + shift)) for shift in shifts]


class Reader(StreamReader):
    """Gives scenes as the world draws them: without the low-pass of the training pictures."""

    def scenes(self, start: int = 0) -> Iterator[tuple[PacketInfo, Scene]]:
        for info, scene in super().scenes(start):
            yield info, replace(scene, sampling=None)


def in_the_stream(
    world: World, *, follow: bool = True, similarity: Similarity | None = None, **metadata: int
) -> Reader:
    """The world as a stream, in the units of the similarity."""
    similarity = similarity or Similarity()
    growth = float(np.log(similarity.scale))
    scaled = [
        replace(
            scene,
            anchors=replace(
                scene.anchors,
                positions=similarity.points(scene.anchors.positions).to(torch.float32),
                log_offset_scales=scene.anchors.log_offset_scales + growth,
                log_base_scales=scene.anchors.log_base_scales + growth,
            ),
        )
        for scene in scenes_of(world, follow=follow)
    ]
    sink = MemorySink()
    header = replace(header_for(scaled[0]), rig=world.rig, similarity=similarity, metadata=metadata)
    write_stream(sink, scaled, header=header)
    return Reader(sink.data)


@pytest.fixture(scope="module")
def world() -> World:
    return moving_world(frames=4, speed=SPEED)


def run(reader: Any, source: Any, **options: Any):
    return evaluate(reader, source, backend=quickest_backend(), **options)


def test_a_perfect_stream_scores_as_equal(world: World) -> None:
    report = run(in_the_stream(world), MemoryCapture(world.rig, world.frames))
    assert report.mean.psnr == PSNR_OF_EQUALS
    assert report.mean.ssim == pytest.approx(1.0)
    assert report.stream["drift_db_per_frame"] == pytest.approx(0.0)
    assert list(report.cameras) == ["cam00"]
    assert report.stream["cameras"] == {"cam00": "held out"}


def test_a_stream_that_stands_still_loses_the_changed_pixels(world: World) -> None:
    report = run(in_the_stream(world, follow=False), MemoryCapture(world.rig, world.frames))
    psnrs = [mean_of(frame).psnr for frame in report.frames]
    assert psnrs == sorted(psnrs, reverse=True)
    assert report.stream["drift_db_per_frame"] < -1
    assert report.stream["drop_from_first_db"] == pytest.approx(psnrs[0] - psnrs[-1])
    last = mean_of(report.frames[-1])
    assert last.psnr_changed < last.psnr < last.psnr_still
    assert mean_of(report.frames[0]).psnr_changed is None
    assert [frame.kind for frame in report.frames] == ["key", "delta", "delta", "key"]


def test_cameras_pass_through_the_similarity_of_the_header(world: World) -> None:
    # The MLPs see the distance, their last input, so the world is drawn without it to be the same at another scale.
    for head in (mlps := deepcopy(world.scene.mlps)):
        head.w1[:, -1] = 0.0
    plain = replace(world, scene=replace(world.scene, mlps=mlps))
    frames = [
        replace(frame, images={name: rendered(scene, world, name) for name in world.rig})
        for frame, scene in zip(world.frames, scenes_of(plain), strict=True)
    ]
    reader = in_the_stream(plain, similarity=Similarity(center=(0.3, -0.2, 0.1), scale=2.5))
    report = run(reader, MemoryCapture(world.rig, frames))
    assert report.mean.psnr > 60  # float32 of another scale: a level here and there


def exposed(frames: list[MultiViewFrame], *, gains: list[float]) -> list[MultiViewFrame]:
    """The frames with the pictures of cam00, which is held out, taken with other gains."""
    taken = []
    for frame, gain in zip(frames, gains, strict=True):
        picture = np.rint(gain * frame.images["cam00"]).clip(0, 255).astype(np.uint8)
        taken.append(replace(frame, images={**frame.images, "cam00": picture}))
    return taken


def test_a_cameras_exposure_is_set_aside_once_and_then_held(world: World) -> None:
    reader = in_the_stream(world)
    report = run(reader, MemoryCapture(world.rig, exposed(world.frames, gains=[0.7, 0.7, 0.7, 0.5])))
    held = [value for frame in report.frames if (value := mean_of(frame).psnr_camera_color) is not None]
    assert len(held) == 4
    assert min(held[:3]) > 50
    assert all(mean_of(frame).psnr < 30 for frame in report.frames)
    # The last frame is darker still: the fit of frame 0 does not follow it, a fit of its own does.
    assert held[3] < 30
    assert mean_of(report.frames[3]).psnr_affine > 50
    assert report.stream["camera_colors"]["cam00"]["gains"] == pytest.approx([0.7] * 3, abs=0.01)
    assert as_json(report)["cameras"]["cam00"]["psnr_camera_color"] == pytest.approx(np.mean(held))


def new_pages(size: int) -> mmap.mmap:
    """Memory that the process did not have: what it freed before is not used again."""
    pages = mmap.mmap(-1, size)
    pages.write(b"1" * size)
    return pages


@pytest.mark.skipif(resident_bytes() is None, reason="the system does not tell the resident size")
def test_the_evaluations_own_memory_is_reported(world: World) -> None:
    """A picture set that is there while frames are scored counts."""
    reader = in_the_stream(world)
    held = []
    before = resident_bytes()
    report = run(
        reader, MemoryCapture(world.rig, world.frames), observer=lambda index, compared: held.append(new_pages(2**24))
    )
    assert report.environment["peak_memory_bytes"] > before + 0.5 * len(held) * 2**24
    assert report.environment["peak_memory_kind"] in ("stage", "process")
    assert report.environment["peak_device_bytes"] is None


def test_the_observer_sees_every_picture(world: World) -> None:
    seen = []
    reader = in_the_stream(world)
    run(
        reader,
        MemoryCapture(world.rig, world.frames),
        cameras=("cam01", "cam00"),
        observer=lambda index, compared: seen.append((index, compared.camera, compared.picture.shape)),
    )
    assert seen[:2] == [(0, "cam01", (32, 48, 3)), (0, "cam00", (32, 48, 3))]
    assert len(seen) == 8


def test_every_score_over_time_is_wired(world: World) -> None:
    """A world that moves, followed and not: what changes from frame to frame, and what is said of what is missing."""
    source = MemoryCapture(world.rig, world.frames)
    follows = run(in_the_stream(world), source)
    stays = run(in_the_stream(world, follow=False), source)
    assert follows.mean.flip == follows.mean.temporal_flip == 0.0
    assert stays.mean.flip > 0.01
    assert stays.mean.temporal_flip > 0.01
    assert follows.mean.e_warp is not None
    assert stays.mean.e_warp is not None
    assert stays.mean.flicker == 0.0
    assert follows.mean.flicker == follows.mean.truth_flicker == stays.mean.truth_flicker
    first = mean_of(stays.frames[0])
    assert {first.e_warp, first.temporal_flip, first.flicker, first.truth_flicker} == {None}
    assert first.flip == 0.0
    missing = follows.stream["not_available"]
    assert "161 pixels" in missing["ms_ssim"]
    assert {"ms_ssim", "lpips_alex", "lpips_vgg", "t_lpips"} == set(missing)
    for name in missing:
        assert getattr(follows.mean, name) is None


def test_the_basic_scores_are_those_of_before(world: World) -> None:
    reader = in_the_stream(world, follow=False)
    basic, every = (run(reader, MemoryCapture(world.rig, world.frames), metrics=which) for which in ("basic", "all"))
    assert basic.stream["metrics"] == "basic"
    assert basic.stream["not_available"] == {}
    assert (basic.mean.psnr, basic.mean.ssim) == (every.mean.psnr, every.mean.ssim)
    assert basic.mean.flip is basic.mean.e_warp is basic.mean.ms_ssim is None


def test_a_part_that_begins_elsewhere_is_refused(world: World) -> None:
    reader = in_the_stream(world, start=2)
    whole: Any = MemoryCapture(world.rig, world.frames * 2)
    assert numbers_of(whole) is None
    assert numbers_of(section(whole, start=1)) is None
    pictures = ImageSource("world", world.rig, 30.0, {name: (Path("x.png"),) * 8 for name in world.rig})
    assert numbers_of(pictures) == range(8)
    assert numbers_of(section(section(pictures, start=1), start=1, frames=4)) == range(2, 6)
    assert numbers_of(section(section(pictures, start=1, every=2), start=1, frames=2)) == range(3, 7, 2)
    with pytest.raises(CaptureError, match="begins at frame 2 .* at frame 1.*start=2"):
        run(reader, section(pictures, start=1))


def test_a_part_of_another_step_is_refused(world: World) -> None:
    pictures = ImageSource("world", world.rig, 30.0, {name: (Path("x.png"),) * 16 for name in world.rig})
    for stated, step in (({}, 2), ({"every": 2}, 1), ({"every": 2}, 3)):
        reader = in_the_stream(world, start=1, **stated)
        with pytest.raises(CaptureError, match=rf"1 in {stated.get('every', 1)} frames .* 1 in {step}; .*every="):
            run(reader, section(pictures, start=1, every=step))


@dataclass
class Ball:
    """A drawable that is no scene."""

    radius: float

    def __len__(self) -> int:
        return 1

    def gaussians(self, camera: Any, backend: Any) -> Gaussians:
        return emerging_ball(0.9 * self.radius)


def test_another_methods_file_is_scored_alike(world: World) -> None:
    reader: Any = in_the_stream(world)
    reader.scenes = lambda start: zip(reader.packets, [Ball(1.0), Ball(1.0), Ball(0.5), Ball(0.5)], strict=True)
    report = run(reader, MemoryCapture(world.rig, world.frames))
    assert [(frame.anchors, frame.free) for frame in report.frames] == [(0, 1)] * 4
    assert 5 < report.mean.psnr < 40


def test_other_sizes_and_the_worst_frames_are_in_the_report(world: World) -> None:
    reader = in_the_stream(world, follow=False)
    rig = world.rig.mapped({name: world.rig[name].resized(96, 64) for name in world.rig})
    frames = [
        replace(one, images={n: p.repeat(2, 0).repeat(2, 1) for n, p in one.images.items()}) for one in world.frames
    ]
    source = MemoryCapture(world.rig, world.frames)
    report = run(reader, source, metrics="basic", stored=MemoryCapture(rig, frames))
    scores = [mean_of(frame) for frame in report.frames]
    assert all(one.psnr_half is not None and one.ssim_half is not None for one in scores)
    assert [one.psnr_stored is not None for one in scores] == [False, False, False, True]
    assert report.stream["stored_size_frames"] == [3]
    assert all(one.disoccluded_share is not None for one in scores)
    changed = [one.psnr_changed or 100.0 for one in scores]
    worst = report.stream["worst"]["changed"]
    assert (worst["frame"], worst["camera"]) == (int(np.argmin(changed)), "cam00")
    assert as_json(report)["frames"][3]["cameras"]["cam00"]["psnr_stored"] == scores[3].psnr_stored
