# SPDX-License-Identifier: Apache-2.0
"""Which sound a stream gets, and how a recorder's file is put in step."""

import json
import shutil
import tracemalloc
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data.open import open_capture
from structgstream.data.prepared import FILE, read_prepared
from structgstream.data.timeline import Clock
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.prepare import prepare_capture
from structgstream.preparation.sound import best_microphone, chosen_sound, file_sound, loudness, recording
from tests.support.quick_streams import CLIP
from tests.support.rooms import write_room
from tests.support.sounds import add_sound, claps, packets_heard, write_sound

SECONDS, RATE = 12.0, 48_000


@pytest.fixture(scope="module")
def noises() -> NDArray[np.float32]:
    """``[1, N]``: claps at no regular distance, over a little noise."""
    rng = np.random.default_rng(1)
    made = claps(SECONDS, *np.cumsum(rng.uniform(0.3, 1.1, 15)))
    return made + 0.002 * rng.standard_normal(made.shape).astype(np.float32)


@pytest.fixture(scope="module")
def capture(noises: NDArray[np.float32], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clip, two cameras of which hear the noises; the other one through more noise."""
    folder = tmp_path_factory.mktemp("heard") / "clip"
    shutil.copytree(CLIP, folder)
    worse = noises + 0.05 * np.random.default_rng(2).standard_normal(noises.shape).astype(np.float32)
    for name, samples in {"cam02": worse, "cam05": noises}.items():
        (folder / f"{name}.mp4").unlink()
        add_sound(Path(CLIP) / f"{name}.mp4", folder / f"{name}.mp4", samples)
    return folder


def test_the_best_microphone(noises: NDArray[np.float32], capture: Path) -> None:
    clear, loud = noises[0], np.clip(30 * noises[0], -1, 1)
    assert best_microphone([("none", None), ("loud", loud), ("clear", clear)]) == "clear"
    assert best_microphone([("still", np.zeros(RATE, np.float32)), ("short", clear[:100])]) is None
    sound = chosen_sound(open_capture(capture), capture, "auto")
    assert sound is not None
    assert (sound.name, sound.clock) == ("cam05", Clock(0.0, 1.0))
    assert chosen_sound(open_capture(capture), capture, None) is None
    assert chosen_sound(open_capture(capture), capture, "none") is None


def test_a_long_recording_takes_little_memory_besides_it() -> None:
    samples = np.random.default_rng(3).uniform(-0.5, 0.5, 600 * RATE).astype(np.float32)
    samples[: 120 * RATE] *= 0.01
    tracemalloc.start()
    try:
        level = loudness(samples)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert level == pytest.approx(40.0, abs=1.0)
    assert peak < samples.nbytes / 2


def test_a_microphone_that_cannot_be_read_costs_no_other(
    noises: NDArray[np.float32], capture: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """One of which the sound is damaged, and one that is longer than two hours."""
    folder = tmp_path / "clip"
    shutil.copytree(capture, folder)
    damage_sound(folder / "cam02.mp4")
    sound = chosen_sound(open_capture(folder), folder, "auto")
    assert sound is not None
    assert sound.name == "cam05"
    (warning,) = [record.message for record in caplog.records]
    assert "cam02.mp4 cannot be decoded" in warning
    file = write_sound(tmp_path / "take.wav", noises)
    assert file_sound(open_capture(folder), file).clock.offset_seconds == pytest.approx(0.0, abs=1e-3)
    monkeypatch.setattr("structgstream.data.sound.LONGEST_SECONDS", 5.0)
    assert recording(folder / "cam05.mp4") is None


def damage_sound(video: Path) -> None:
    """Overwrites the sound of a video."""
    with av.open(str(video)) as container:
        places = [(packet.pos, packet.size) for packet in container.demux(container.streams.audio[0]) if packet.size]
    data = bytearray(video.read_bytes())
    for place, size in places[20:]:
        data[place : place + size] = b"\xff" * size
    video.write_bytes(data)


@pytest.mark.parametrize("early", [1.7, -2.4])
def test_a_recorder_s_file_is_put_in_step_by_what_cameras_hear(
    capture: Path, noises: NDArray[np.float32], tmp_path: Path, early: float
) -> None:
    moved = round(abs(early) * RATE)
    samples = np.pad(noises, ((0, 0), (moved, 0))) if early > 0 else noises[:, moved:]
    recorder = write_sound(tmp_path / "recorder.wav", samples)
    sound = file_sound(open_capture(capture), recorder)
    assert sound.clock.offset_seconds == pytest.approx(-early, abs=0.002)
    assert sound.name == "recorder.wav"
    part = file_sound(open_capture(capture, start=3), recorder)
    assert part.clock.offset_seconds == pytest.approx(-early - 0.1, abs=0.002)


def test_cameras_that_do_not_hear_a_file_keep_no_other_from_being_compared(
    capture: Path, noises: NDArray[np.float32], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("structgstream.preparation.sound.MAX_HEARING", 1)
    folder = tmp_path / "clip"
    shutil.copytree(capture, folder)
    add_sound(Path(CLIP) / "cam00.mp4", tmp_path / "cam00.mp4", claps(5.0, 1.0, 2.0, 2.2, 4.1)).replace(
        folder / "cam00.mp4"
    )
    recorder = write_sound(tmp_path / "recorder.wav", noises[:, RATE:])
    assert file_sound(open_capture(folder), recorder).clock.offset_seconds == pytest.approx(1.0, abs=0.002)


def test_a_file_that_no_camera_hears_begins_with_the_capture_which_is_said(
    capture: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = write_sound(tmp_path / "music.wav", claps(5.0, 1.0, 2.0, 2.2, 4.1))
    assert file_sound(open_capture(capture, start=3), other).clock == Clock(-0.1)
    (warning,) = [record.message for record in caplog.records if "hears" in record.message]
    assert warning.endswith("--sound-offset SECONDS gives another time")
    assert file_sound(open_capture(capture, start=3), other, offset_seconds=2.0).clock == Clock(1.9)


def test_a_file_whose_stamps_do_not_begin_with_0_begins_when_it_is_said_to(capture: Path, tmp_path: Path) -> None:
    add_sound(Path(CLIP) / "cam00.mp4", tmp_path / "take.mp4", claps(2.0, 0.5))
    with av.open(str(tmp_path / "take.mp4")) as given, av.open(str(tmp_path / "take.ts"), "w") as container:
        streams = {stream: container.add_stream_from_template(stream) for stream in given.streams}
        for packet in given.demux():
            if packet.size and packet.pts is not None and packet.dts is not None and packet.time_base is not None:
                later = round(3600 / packet.time_base)
                packet.pts, packet.dts = packet.pts + later, packet.dts + later
                packet.stream = streams[packet.stream]
                container.mux(packet)
    feed = file_sound(open_capture(capture), tmp_path / "take.ts", offset_seconds=0.25).open()
    assert packets_heard(feed.until(9.0)) == pytest.approx([0.75], abs=0.03)


def test_a_prepared_capture_states_its_microphone(tmp_path: Path) -> None:
    """As an older or another program wrote it, too."""
    camera = {
        "files": "videos/a.mp4", "size": [64, 48], "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]],
        "lens": {"model": "pinhole"}, "viewmat": np.eye(4).tolist(), "clock": {"offset_seconds": 0.0, "rate": 1.0},
        "pinhole": {"size": [64, 48], "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]]},
    }  # fmt: skip
    content = {
        "format": "structgstream-capture", "version": 1, "fps": 30.0, "unit": "metres", "near": 0.1, "held_out": [],
        "points": None, "cameras": {"a": camera},
    }  # fmt: skip
    for stated, expected in ({}, None), ({"sound": "a"}, "a"), ({"sound": "gone"}, None):
        (tmp_path / FILE).write_text(json.dumps(content | stated))
        assert read_prepared(tmp_path).sound == expected


def test_prepare_chooses_the_microphone_that_reconstruct_takes(noises: NDArray[np.float32], tmp_path: Path) -> None:
    videos, out = tmp_path / "videos", tmp_path / "out"
    names = [*write_room(videos)]
    worse = noises + 0.05 * np.random.default_rng(2).standard_normal(noises.shape).astype(np.float32)
    for name, samples in ((names[1], worse), (names[2], noises)):
        video = next(videos.glob(f"{name}.*"))
        add_sound(video, tmp_path / video.name, samples).replace(video)
    made = prepare_capture(videos, out, options=PrepareOptions(synchronize="none"))
    assert made.steps["sound"] == f"the microphone of {names[2]} is the best"
    sound = chosen_sound(open_capture(out), out, None)
    assert sound is not None
    assert sound.name == names[2]
    assert chosen_sound(open_capture(out), out, "none") is None
