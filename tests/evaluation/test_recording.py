# SPDX-License-Identifier: Apache-2.0
"""Recordings: what is known of one before a picture is looked at, its capture, and where it is drawn."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from structgstream.cameras import Camera, CameraRig, Similarity
from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.data.open import open_capture
from structgstream.errors import BackendError, CaptureError, ConfigError
from structgstream.evaluation.recording import (
    capture_of,
    captures_of,
    check_same_frames,
    check_same_rig,
    scored_cameras,
    stream_facts,
    to_device,
    training_facts,
)
from structgstream.frames import MultiViewFrame
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from tests.support.memory_captures import MemoryCapture
from tests.support.rigs import arc_rig
from tests.support.small_clip import small_clip_path
from tests.support.streams import header_for, small_scene

CPU, ELSEWHERE = torch.device("cpu"), torch.device("meta")


class Fixed:
    """Drawable, and bound to the CPU."""

    def gaussians(self, camera: Camera, backend: Backend) -> Gaussians:
        raise NotImplementedError


class Roaming(Fixed):
    """As well on another device."""

    def on_device(self, device: torch.device) -> Fixed:
        self.device = device
        return self


def test_a_drawable_goes_to_a_device_if_it_can() -> None:
    scene, fixed, roaming = small_scene(), Fixed(), Roaming()
    found = to_device(scene, ELSEWHERE)
    assert found.anchors.positions.device == ELSEWHERE  # type: ignore[attr-defined]
    assert to_device(fixed, CPU) is fixed
    assert to_device(roaming, ELSEWHERE) is roaming
    assert roaming.device == ELSEWHERE
    with pytest.raises(BackendError, match="A Fixed cannot be drawn on meta; choose --device cpu"):
        to_device(fixed, ELSEWHERE)


CLIP = small_clip_path()


@pytest.mark.parametrize(("scale", "size"), [(0.25, (80, 60)), (0.33, (106, 79))])
def test_start_step_and_scale_are_those_of_the_stream(scale: float, size: tuple[int, int]) -> None:
    """At 0.33 the width is rounded up and the height down, so that neither gives the scale back."""
    made_from = open_capture(CLIP, start=1, scale=scale, every=3)
    header = replace(header_for(small_scene()), rig=made_from.rig, metadata={"start": 1, "every": 3})
    assert [len(capture_of(header, CLIP, frames=frames)) for frames in (2, 99, None)] == [2, 4, 4]
    found = capture_of(header, CLIP, frames=2)
    assert found.fps == made_from.fps
    assert (found.rig["cam01"].width, found.rig["cam01"].height) == size
    check_same_rig(header, found, tuple(header.rig))
    for one, wanted in zip(found.frames(), made_from.frames(), strict=False):
        assert (one.images["cam01"] == wanted.images["cam01"]).all()
    assert len(capture_of(replace(header, metadata={"start": 3}), CLIP, frames=None)) == 9


def test_stored_pictures_are_found_where_they_are_larger() -> None:
    made_from = open_capture(CLIP, start=3, scale=0.5, every=2)
    header = replace(header_for(small_scene()), rig=made_from.rig, metadata={"start": 3, "every": 2})
    _, found = captures_of(header, CLIP, frames=3)
    assert len(found) == 3
    assert (found.rig["cam01"].width, found.rig["cam01"].height) == (320, 240)
    wanted = [frame.images["cam01"] for frame in open_capture(CLIP, start=3, frames=5).frames()]
    for frame, number in zip(found.frames(), (0, 2, 4), strict=True):
        assert (frame.images["cam01"] == wanted[number]).all()
    whole = replace(header, rig=open_capture(CLIP).rig)
    assert captures_of(whole, CLIP, frames=3)[1] is None


def test_a_capture_that_ends_before_the_stream_begins_is_reported() -> None:
    header = replace(header_for(small_scene()), metadata={"start": 12})
    with pytest.raises(CaptureError, match="12 frames"):
        capture_of(header, CLIP, frames=1)


HEADER = header_for(small_scene())


def source(rig: CameraRig) -> MemoryCapture:
    """A capture of a kind that does not say where it begins, with four frames."""
    return MemoryCapture(rig, [MultiViewFrame(i, i / 30, {}) for i in range(4)], name="hall")


def recording(sizes: list[dict[Any, int]], header: StreamHeader = HEADER) -> Any:
    """The numbers of an opened file."""
    packets = [
        PacketInfo(PacketKind.DELTA if i % 2 else PacketKind.KEY, i, i / 30, 0, 10 + sum(own.values()), own)
        for i, own in enumerate(sizes)
    ]
    total = 500 + sum(info.bytes for info in packets) + 40
    return SimpleNamespace(header=header, packets=packets, header_bytes=500, total_bytes=total, complete=True)


def test_cameras_to_score_are_the_named_or_the_held_out() -> None:
    assert scored_cameras(HEADER, None) == ("cam00",)
    assert scored_cameras(HEADER, ("cam02", "cam01", "cam02")) == ("cam02", "cam01")
    with pytest.raises(ConfigError, match="no camera 'cam9'; it has cam00, cam01, cam02"):
        scored_cameras(HEADER, ("cam00", "cam9"))
    with pytest.raises(ConfigError, match="no held-out camera to score"):
        scored_cameras(replace(HEADER, rig=HEADER.rig.with_held_out(frozenset())), None)


def without(rig: CameraRig, name: str) -> CameraRig:
    return CameraRig({key: camera for key, camera in rig.cameras.items() if key != name}, frozenset())


def with_camera(rig: CameraRig, name: str, **change: Any) -> CameraRig:
    return rig.mapped({**rig.cameras, name: replace(rig[name], **change)})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda rig: without(rig, "cam01"),
            "has no camera 'cam01', which the stream has; its cameras are cam00, cam02",
        ),
        (lambda _: arc_rig(3, width=96, height=64), "96x64 pixels in the capture hall and 48x32 in the stream"),
        (lambda rig: with_camera(rig, "cam01", K=rig["cam01"].K * 1.01), "another calibration"),
        (lambda rig: with_camera(rig, "cam01", viewmat=rig["cam02"].viewmat), "another calibration"),
    ],
)
def test_another_rig_is_reported(change: Callable[[CameraRig], CameraRig], words: str) -> None:
    check_same_rig(HEADER, source(HEADER.rig), ("cam00", "cam01"))
    other = source(change(HEADER.rig))
    with pytest.raises(CaptureError, match=words):
        check_same_rig(HEADER, other, ("cam01",))


@pytest.mark.parametrize("similarity", [Similarity(scale=1e-4), Similarity((-5e5, -5.4e6, 0.0))])
def test_another_pose_is_reported_whatever_the_units(similarity: Similarity) -> None:
    header = replace(HEADER, rig=similarity.rig(HEADER.rig))
    check_same_rig(header, source(header.rig), ("cam01",))
    viewmat = header.rig["cam01"].viewmat.clone()
    viewmat[0, 3] += 0.01 * similarity.scale
    with pytest.raises(CaptureError, match="another calibration"):
        check_same_rig(header, source(with_camera(header.rig, "cam01", viewmat=viewmat)), ("cam01",))


def test_a_capture_of_another_name_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    check_same_rig(replace(HEADER, metadata={"capture": "hall"}), source(HEADER.rig), ("cam01",))
    assert not caplog.text
    check_same_rig(replace(HEADER, metadata={"capture": "take1"}), source(HEADER.rig), ("cam01",))
    assert "The stream was made from the capture 'take1', and is compared with 'hall'" in caplog.text


def test_a_camera_that_is_not_scored_may_differ() -> None:
    check_same_rig(HEADER, source(without(HEADER.rig, "cam01")), ("cam00", "cam02"))


def test_a_capture_that_is_too_short_or_begins_elsewhere_is_reported() -> None:
    hall, four = source(HEADER.rig), [{"free": 1}] * 4
    check_same_frames(recording(four), hall)
    with pytest.raises(CaptureError, match="5 frames and this part of the capture hall only 4"):
        check_same_frames(recording([*four, {}]), hall)
    late = recording(four, replace(HEADER, metadata={"start": 7}))
    check_same_frames(late, hall)
    gapped = recording(four)
    gapped.packets[2] = replace(gapped.packets[2], pts_seconds=0.1)
    with pytest.raises(CaptureError, match=r"Frame 2 of the stream is of 0\.100 s, and that of .* hall of 0\.067 s"):
        check_same_frames(gapped, hall)


def test_sizes_and_rates_by_hand() -> None:
    """Packets of 110, 60 and 110 bytes, heads of 10 each, in a tenth of a second."""
    facts = stream_facts(
        recording([{"free": 100}, {"free": 20, "offset_scales": 30}, {"free": 100}]), ("cam00", "cam02")
    )
    assert (facts["frames"], facts["key_frames"], facts["training_cameras"]) == (3, 2, 2)
    assert (facts["header_bytes"], facts["packet_bytes"], facts["total_bytes"]) == (500, 280, 820)
    assert facts["field_bytes"] == {"free": 220, "offset_scales": 30}
    assert facts["megabits_per_second"] == pytest.approx(280 * 8 / 1e6 / 0.1)
    assert facts["megabits_per_second_with_header"] == pytest.approx(820 * 8 / 1e6 / 0.1)
    assert facts["cameras"] == {"cam00": "held out", "cam02": "training"}
    assert (facts["metadata"], facts["config"]) == ({"capture": "test"}, HEADER.config)
    sparse = recording([{}, {}])  # two frames 2 s apart
    sparse.packets[1] = replace(sparse.packets[1], pts_seconds=2 - 1 / 30)
    assert stream_facts(sparse, ())["megabits_per_second"] == pytest.approx(20 * 8e-6 / 2)


def log(index: int, seconds: float, peak: int | None, **stages: int) -> dict[str, Any]:
    return {"index": index, "total_seconds": seconds, "peak_memory_bytes": peak, "peak_memory_bytes_by_stage": stages}


def test_what_training_took_is_reported_frame_0_and_of_the_others_apart() -> None:
    facts = training_facts(
        [log(0, 9.0, 50, fit=50), log(1, 1.0, 70, fit=70, store=5), {}, log(2, 3.0, 60, fit=60, store=6)]
    )
    assert facts == {
        "seconds_first": 9.0,
        "seconds_online_mean": 2.0,
        "peak_memory_bytes": 70,
        "peak_memory_bytes_by_stage": {"first frame, fit": 50, "online, fit": 70, "online, store": 6},
    }
    assert training_facts([{}, {}]) == {}
    resumed = training_facts([log(5, 1.0, None)])
    assert (resumed["seconds_first"], resumed["peak_memory_bytes"]) == (None, None)
    assert training_facts([log(0, 1.0, 5)])["seconds_online_mean"] is None
