# SPDX-License-Identifier: Apache-2.0
"""The tool that films a capture again as phones would, against what PyAV says of its files."""

import json
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from structgstream.cameras import CameraRig
from structgstream.data.timeline import Clock
from structgstream.data.video import synchronised
from structgstream.data.video_index import scan_videos
from structgstream.frames import MultiViewFrame
from tests.support.captures import numbers, picture
from tests.support.rigs import arc_rig

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT, FRAMES = 128, 96, 8


class Numbered:
    """Four cameras whose pictures carry the number of their camera and frame."""

    name, fps, points = "numbered", 30.0, None
    rig: CameraRig = arc_rig(4, width=WIDTH, height=HEIGHT)

    def __len__(self) -> int:
        return FRAMES

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for index in range(start, FRAMES):
            shown = {name: picture(i, index, width=WIDTH, height=HEIGHT) for i, name in enumerate(self.rig)}
            yield MultiViewFrame(index, index / self.fps, shown)


@pytest.fixture(scope="module")
def tool() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "lab" / "phones" / "film.py"))


@pytest.fixture(scope="module")
def filmed(tool: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phones")
    phones = tool["planned"](Numbered(), clap=0.1, place=(0, 0, 0), metres=1.0, seed=11, turns=(0, 1, 2, 3))
    tool["write_phones"](Numbered(), folder, phones)
    return folder


def truth(filmed: Path) -> dict[str, Any]:
    return json.loads((filmed / "truth.json").read_text())["phones"]


def test_videos_are_hevc_with_ten_bits_and_hold_the_frames_that_the_phone_has(filmed: Path) -> None:
    for number, (name, phone) in enumerate(truth(filmed).items()):
        with av.open(str(filmed / f"{name}.mov")) as container:
            stream = container.streams.video[0]
            assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("hevc", "yuv420p10le")
            frames = list(container.decode(stream))
        stamps = [float(frame.pts * frame.time_base) for frame in frames]  # pyright: ignore[reportOperatorIssue]
        np.testing.assert_allclose(stamps, phone["stamps"], atol=1e-5)
        turned = [np.rot90(frame.to_ndarray(format="rgb24"), phone["quarter_turns"]) for frame in frames]
        shown = [np.ascontiguousarray(picture, np.uint8) for picture in turned]
        assert [numbers(picture) for picture in shown] == [(number, i) for i in phone["frames"]]


def test_phones_begin_late_and_drop_frames(filmed: Path) -> None:
    frames = [phone["frames"] for phone in truth(filmed).values()]
    assert len({own[0] for own in frames}) > 1
    assert any(own != list(range(own[0], FRAMES)) for own in frames)


def test_metadata_turn_the_pictures(filmed: Path) -> None:
    assert [phone["quarter_turns"] for phone in truth(filmed).values()] == [0, 1, 2, 3]
    for name, phone in truth(filmed).items():
        with av.open(str(filmed / f"{name}.mov")) as container:
            assert (next(container.decode(video=0)).rotation - 90 * phone["quarter_turns"]) % 360 == 0


def test_a_stamp_is_the_capture_s_time_but_for_the_phone_s_zero_and_jitter(filmed: Path) -> None:
    for phone in truth(filmed).values():
        common = np.array(phone["stamps"]) + phone["offset_seconds"]
        np.testing.assert_allclose(common, np.array(phone["frames"]) / 30, atol=0.006)


def test_microphones_hear_the_clap_late_by_its_distance(filmed: Path) -> None:
    for name, phone in truth(filmed).items():
        with av.open(str(filmed / f"{name}.mov")) as container:
            samples = np.concatenate([frame.to_ndarray()[0] for frame in container.decode(audio=0)])
        loud = int(np.argmax(np.abs(samples) > 0.15)) / 48_000
        assert loud == pytest.approx(phone["clap_seconds"], abs=0.003)
        distance = float(Numbered.rig[name].center.norm())
        assert phone["clap_seconds"] + phone["offset_seconds"] == pytest.approx(0.1 + distance / 343)


def test_read_by_true_clocks_every_frame_has_the_cameras_that_filmed_it(filmed: Path) -> None:
    phones = truth(filmed)
    clocks = {name: Clock(phone["offset_seconds"]) for name, phone in phones.items()}
    tracks = scan_videos({name: filmed / f"{name}.mov" for name in phones})
    source = synchronised(tracks, Numbered.rig, where=filmed, fps=30, clocks=clocks)
    order = list(Numbered.rig)
    first = max(phone["frames"][0] for phone in phones.values())
    assert len(source) == FRAMES - first
    for index, frame in enumerate(source.frames(), start=first):
        there = {name for name, phone in phones.items() if index in phone["frames"]}
        assert {name: numbers(image) for name, image in frame.images.items()} == {
            name: (order.index(name), index) for name in there
        }


def test_one_seed_drops_the_same_frames(tool: dict[str, Any], filmed: Path) -> None:
    again = tool["planned"](Numbered(), clap=0.1, place=(0, 0, 0), metres=1.0, seed=11, turns=(0, 1, 2, 3))
    assert {name: list(phone.frames) for name, phone in again.items()} == {
        name: phone["frames"] for name, phone in truth(filmed).items()
    }
