# SPDX-License-Identifier: Apache-2.0
"""Whole live sources over loopback and over files, small streams of a second or two each; lenses, masks and sizes of
their calibration."""

import io
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest

from structgstream.data.dataset_layouts import bundled_clip, bundled_clip_path
from structgstream.data.denoising import DenoisingConfig
from structgstream.data.lenses import LensCamera, Pinhole, RadialTangential
from structgstream.data.live import recorder as recording
from structgstream.data.live import source as source_module
from structgstream.data.live.source import LiveOptions, LiveSource, read_calibration
from structgstream.data.live.status import FaultLog
from structgstream.data.live.synchronizer import LivePicture, PictureSet
from structgstream.data.open import open_capture
from structgstream.data.prepared import PreparedCamera, PreparedCapture, filmed_rig, write_prepared
from structgstream.data.source import frame_count, is_recording
from structgstream.data.undistortion import Undistortion
from structgstream.data.video import srgb
from structgstream.errors import CaptureError, ConfigError, StorageError
from structgstream.frames import MultiViewFrame
from structgstream.opus import PACKET_SECONDS
from tests.support.captures import small_rig, write_picture
from tests.support.rigs import arc_rig
from tests.support.sender_modules import coded_film, moving_pictures, number_shown, sender, sent_loops, sent_stream
from tests.support.sounds import add_sound, claps, packets_heard
from tests.support.varied import varied

NAMES = ("a", "b", "c")
FPS = 30.0


def calibrated(folder: Path) -> Path:
    """The calibration of three cameras of 128x96 pixels, the first of which is held out."""
    rig = arc_rig(3, width=128, height=96)
    cameras = dict(zip(NAMES, rig.cameras.values(), strict=True))
    capture = PreparedCapture(
        {name: PreparedCamera(f"{name}.mp4", LensCamera(own, Pinhole()), own) for name, own in cameras.items()},
        FPS,
        0.1,
        held_out=frozenset("a"),
    )
    folder.mkdir(exist_ok=True)
    write_prepared(folder, capture)
    return folder


def rig_file(folder: Path, urls: dict[str, str], **settings: object) -> Path:
    path = folder / "rig.toml"
    text = sender().rig_text(urls, calibrated(folder / "calibration"), **settings)
    path.write_text(text if "://" in text else text.replace('format = "mpegts"\n', ""))
    return path


def files(folder: Path, frames: int = 30, **troubles: str) -> Path:
    """A rig file of three files."""
    for name in NAMES:
        own = [troubles[name]] if name in troubles else []
        (folder / f"{name}.ts").write_bytes(sent_stream(*own, frames=frames))
    urls = {name: f"{name}.ts" for name in NAMES}
    return rig_file(folder, urls, clock="stream", deadline_seconds=2.0, queue_frames=100)


def live(rig: Path, **options: Any) -> LiveSource:
    """The source of a rig file, whose stream lies beside it."""
    return LiveSource(rig, rig.with_name("x.sgs"), LiveOptions(**options))


@contextmanager
def sending(transport: str, *troubles: str) -> Iterator[dict[str, str]]:
    """Three cameras that send until the end of the block, and their URLs."""
    module, stop = sender(), threading.Event()
    lines, urls = module.opened_lines(transport, NAMES)
    parsed = [module.Trouble.parsed(trouble) for trouble in troubles]
    cameras = [
        module.SentCamera(name, sent_loops(), lines[name], FPS, [one for one in parsed if one.camera == name])
        for name in NAMES
    ]
    thread = threading.Thread(target=module.film, args=(cameras, stop))
    thread.start()
    try:
        yield urls
    finally:
        stop.set()
        thread.join()
        for line in lines.values():
            line.close()


@pytest.mark.parametrize("transport", ["udp", "tcp", "http"])
def test_sets_of_one_instant_come_over_the_network(tmp_path: Path, transport: str) -> None:
    with sending(transport) as urls:
        source = live(rig_file(tmp_path, urls, clock="unix"), frames=5)
        assert frame_count(source) is None
        assert not is_recording(source)
        frames = list(source.frames())
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert frames[0].pts_seconds == 0.0
    assert all(one.pts_seconds < other.pts_seconds for one, other in pairwise(frames))
    for frame in frames:
        assert len({number_shown(image) for image in frame.images.values()}) == 1, "pictures of one instant"
        assert frame.captured_unix_seconds is not None
    assert [*frames[0].images] == list(NAMES)
    status = source.status()
    ages = [status.arrived_seconds, status.matched_seconds, status.delay_seconds]
    arrived, matched, handed = (age for age in ages if age is not None)
    assert 0.0 < arrived <= matched <= handed < 30.0


def test_network_cameras_are_asked_by_rtsp_and_asked_again(tmp_path: Path) -> None:
    """Their stamps begin anew with each connection, so arrival says when a picture was taken."""
    with sending("rtsp", "a:cut:1.5:0.5") as urls:
        path = rig_file(tmp_path, urls, clock="arrival", deadline_seconds=0.3, silent_seconds=2)
        source, seen = live(path), []
        for frame in source.frames():
            seen.append("a" in frame.images)
            if False in seen and seen[-1]:
                break
            assert frame.index < 900
    assert seen[0]
    assert source.faults.counts["a"]["gone"] >= 1
    assert all("jump" not in counts for counts in source.faults.counts.values())


def test_a_slow_trainer_skips_what_was_filmed_while_nobody_asked(tmp_path: Path) -> None:
    with sending("udp") as urls:
        source = live(rig_file(tmp_path, urls, clock="unix"), frames=3)
        frames = source.frames()
        first = next(frames)
        threading.Event().wait(0.5)
        second = next(frames)
        status = source.status()
        frames.close()  # type: ignore[attr-defined]
    assert second.pts_seconds - first.pts_seconds > 0.3
    assert status.skipped_sets >= 5
    assert all(camera.present for camera in status.cameras.values())


def test_sets_of_fewer_than_two_training_cameras_are_no_frames(tmp_path: Path) -> None:
    """A camera is held out, so without b only one is left."""
    with sending("http", "b:cut:2.0:0.8") as urls:  # A busy machine opens all cameras before that.
        path = rig_file(tmp_path, urls, clock="unix", deadline_seconds=0.2, silent_seconds=1)
        source = live(path)
        last, gap = 0.0, 0.0
        for frame in source.frames():
            assert {"b", "c"} <= set(frame.images)
            gap, last = max(gap, frame.pts_seconds - last), frame.pts_seconds
            if gap > 0.5:
                break
            assert frame.index < 600
        assert source.status().small_sets >= 5


def test_every_set_of_files_comes_and_then_the_stream_ends(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    source = live(files(tmp_path))
    frames = list(source.frames())
    numbers = [round(frame.pts_seconds * FPS) for frame in frames]
    assert [number_shown(frame.images["a"]) for frame in frames] == [n % 12 for n in numbers]
    assert np.allclose([frame.pts_seconds for frame in frames], np.array(numbers) / FPS, atol=1e-4)
    assert all(len(frame.images) == 3 for frame in frames)
    skipped = source.status().skipped_sets
    assert len(frames) == 30 - skipped, "every set, or it is counted"
    assert "have come to their end" in caplog.text


@pytest.mark.parametrize("content", [None, b"", b"no video at all"], ids=["missing", "empty", "no video"])
def test_a_file_that_cannot_be_read_is_absent_and_the_stream_ends(
    tmp_path: Path, content: bytes | None, caplog: pytest.LogCaptureFixture
) -> None:
    """Frame 0 does not wait for it either, and a recording does not name it: that would be refused as a capture."""
    path, folder = files(tmp_path), tmp_path / "take"
    (tmp_path / "a.ts").unlink()
    if content is not None:
        (tmp_path / "a.ts").write_bytes(content)
    frames = list(live(path, record=folder).frames())
    assert len(frames) >= 20
    assert all([*frame.images] == ["b", "c"] for frame in frames)
    again = open_capture(folder)
    assert [*again.rig] == ["b", "c"]
    assert len(again) == 30
    (reported,) = [text for text in caplog.messages if "camera 'a'" in text]
    assert f"its file {tmp_path / 'a.ts'} cannot be read (" in reported
    assert "correct its url in the rig file, or give follow = true" in reported
    assert "have come to their end" in caplog.text


def test_a_rig_without_a_frame_is_refused(tmp_path: Path) -> None:
    path = files(tmp_path)
    for name in "ab":
        (tmp_path / f"{name}.ts").unlink()
    with pytest.raises(CaptureError, match=r"rig has no frame: all files .* Frame 0 needs pictures of 2 training cam"):
        list(live(path).frames())


def test_a_file_that_ends_first_is_not_waited_for(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = files(tmp_path)
    (tmp_path / "b.ts").write_bytes(sent_stream(frames=12))
    frames = list(live(path, held_out=()).frames())
    assert round(frames[-1].pts_seconds * FPS) == 29
    assert [*frames[-1].images] == ["a", "c"]
    assert f"camera 'b' has come to the end of its file {tmp_path / 'b.ts'}; it is absent from now on" in caplog.text
    assert "again" not in caplog.text


def test_frame_0_is_averaged(tmp_path: Path) -> None:
    """The film moves everywhere but at its rims."""
    denoising = varied(DenoisingConfig(frames=3), THRESHOLD=0.1, REACH_PIXELS=0)
    path = files(tmp_path)
    source = live(path, denoising=denoising)
    frames = list(source.frames())
    assert frames[0].mean_of > 1.2
    assert all(frame.mean_of == 1.0 for frame in frames[1:])
    assert [frame.index for frame in frames] == list(range(len(frames)))
    (again,) = islice(live(path, resume=True).frames(0), 1)
    assert (again.images["b"] == frames[0].images["b"]).all(), "the averaged pictures are stored"


def test_a_resumed_stream_gets_the_pictures_that_no_camera_sends_again(tmp_path: Path) -> None:
    path = files(tmp_path)
    first = list(islice(live(path).frames(), 6))
    again = live(path, resume=True, frames=8)
    (zero,) = islice(again.frames(0), 1)
    assert (zero.images["b"] == first[0].images["b"]).all()
    frames = list(again.frames(4))
    assert [frame.index for frame in frames] == [4, 5, 6, 7]
    assert all((frames[0].images[name] == first[4].images[name]).all() for name in "bc")
    assert frames[0].pts_seconds == first[4].pts_seconds
    # The files begin anew, as a camera's clock may: time goes on.
    assert frames[2].pts_seconds == pytest.approx(frames[1].pts_seconds + 1 / FPS)
    with pytest.raises(CaptureError, match="cannot be resumed"):
        next(again.frames(30))


@pytest.mark.parametrize("start", [0, 6])
def test_the_first_frame_of_a_run_waits_for_cameras_that_still_send(tmp_path: Path, start: int) -> None:
    source = live(files(tmp_path), held_out=())
    sets = [["a", "b"], ["a", "b", "c"], ["a", "b"]]
    arriving = iter(MultiViewFrame(0, 0.0, {name: np.ones((96, 128, 3), np.uint8) for name in names}) for names in sets)
    source._taken = lambda ingest: next(arriving)  # type: ignore[method-assign]
    ingest: Any = SimpleNamespace(end_reason=None, open_cameras={"a", "b", "c"})
    frames = list(islice(source._arriving(ingest, start), 2))
    assert [[*frame.images] for frame in frames] == sets[1:]


def test_a_stream_is_stopped_between_two_frames(tmp_path: Path) -> None:
    source = live(files(tmp_path))
    frames = source.frames()
    next(frames)
    source.stop()
    assert list(frames) == []
    assert [thread for thread in threading.enumerate() if thread.name.startswith(("camera", "synchronizer"))] == []


def test_what_is_recorded_is_a_capture_of_the_same_instants(tmp_path: Path) -> None:
    path, folder = files(tmp_path, b="garbage:0.5:0.2"), tmp_path / "take"
    sent = list(live(path, record=folder).frames())
    again = open_capture(folder)
    recorded = list(again.frames())
    assert [*again.rig] == list(NAMES)
    assert again.rig.held_out == frozenset("a")
    assert again.fps == FPS
    assert len(recorded) == 30
    for frame in recorded:
        assert {number_shown(image) for image in frame.images.values()} == {frame.index % 12}
    # What was lost live is lost again, and nothing else.
    for frame in sent:  # fewer where this machine was too slow
        assert ("b" in frame.images) == ("b" in recorded[round(frame.pts_seconds * FPS)].images)
    lines = (folder / "timestamps.csv").read_text().splitlines()
    assert lines[0] == "camera,recorded_seconds,common_seconds,key"
    assert sum(line.startswith("a,") for line in lines) == 30
    assert 0 < len((folder / "frames.jsonl").read_text().splitlines()) == len(sent)


def test_masks_of_the_calibration_count_live_and_in_the_recording(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Those for all frames, of cameras that are used."""
    path, folder, masks = files(tmp_path), tmp_path / "take", tmp_path / "calibration" / "masks"
    head, _, rest = path.read_text().partition("[cameras.a]")
    path.write_text(f'without = ["a"]\n{head}{rest[rest.index("[cameras.b]") :]}')
    left = np.broadcast_to(np.arange(128) < 64, (96, 128))
    for file in ("a.png", "b.png", "c/000000.png"):
        write_picture(masks / file, np.repeat(left[..., None], 3, axis=2).astype(np.uint8) * 255)
    for frame in (*live(path, record=folder).frames(), *open_capture(folder).frames()):
        assert [*frame.masks] == ["b"]
        np.testing.assert_array_equal(frame.masks["b"], left)
    assert "the masks of single frames of camera 'c' are not used: it is live" in caplog.text


def test_pictures_of_other_proportions_are_not_recorded(tmp_path: Path) -> None:
    path, folder = files(tmp_path, frames=48, c="shape:0.4:0.4"), tmp_path / "take"
    list(live(path, record=folder).frames())
    recorded = list(open_capture(folder).frames())
    assert {frame.index for frame in recorded if "c" not in frame.images} >= set(range(12, 24))
    for frame in recorded:
        assert all(number_shown(image) == frame.index % 12 for image in frame.images.values())


def test_a_recording_that_is_cut_can_be_read_up_to_there(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    list(live(files(tmp_path), record=folder).frames())
    for name in NAMES:
        file = folder / f"{name}.ts"
        file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3 // 188 * 188])
    again = open_capture(folder)
    assert 15 <= len(again) < 30
    assert all(number_shown(frame.images["c"]) == frame.index % 12 for frame in again.frames() if "c" in frame.images)


def test_a_long_recording_goes_on_in_parts_at_key_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A part ends within the first group of 12 frames, so the next begins with the second."""
    monkeypatch.setattr(recording, "PART_SECONDS", recording.LEAD_SECONDS + 0.3)
    folder = tmp_path / "take"
    list(live(files(tmp_path), record=folder).frames())
    first, second = (list(open_capture(part).frames()) for part in (folder, folder / "part-001"))
    assert [number_shown(frame.images["b"]) for frame in first] == list(range(12))
    assert [number_shown(frame.images["b"]) for frame in second] == [n % 12 for n in range(18)]


def begun(folder: Path) -> recording.Recording:
    """A recording in the folder ``take``."""
    calibration = read_calibration(calibrated(folder / "c"))
    return recording.Recording(folder / "take", calibration, fps=FPS, masks=folder)


def record(recorder: recording.CameraRecorder, film: bytes, *, shift_seconds: float = 0.0) -> None:
    """Records the packets of a film."""
    with av.open(io.BytesIO(film), "r") as container:
        for packet in container.demux(video=0):
            if packet.size:
                recorder.record(packet, shift_seconds=shift_seconds)


NO_FAULTS = FaultLog("rig", now=lambda: 0.0)


def test_a_camera_that_comes_back_with_another_codec_goes_on_in_the_next_part(tmp_path: Path) -> None:
    folder, kept = tmp_path / "take", begun(tmp_path)
    recorders = {name: kept.camera(name, NO_FAULTS) for name in NAMES}
    for first in range(0, 48, 12):
        for name in ("b", "a", "c"):
            codec = "mpeg2video" if name == "b" and first >= 24 else "libx264"
            film = coded_film(codec, range(first, first + 12), g="6", bf="0", tune="zerolatency")
            record(recorders[name], film)
    kept.close()
    assert not (folder / "part-002").exists(), "one change, one part"
    parts = [list(open_capture(part).frames()) for part in (folder, folder / "part-001")]
    assert [len(frames) for frames in parts] == [24, 24]
    for frame in (*parts[0], *parts[1]):
        assert {number_shown(image) for image in frame.images.values()} == {frame.index % 12}
        assert [*frame.images] == list(NAMES)


def test_recordings_at_a_time_in_one_folder_replace_nothing_of_each_other(tmp_path: Path) -> None:
    """The second begins with part 1, and so the first goes on in part 2."""
    folder, first, second = tmp_path / "take", begun(tmp_path), begun(tmp_path)
    second.add_line(0, "frames.jsonl", "second\n")
    first.part_at(0.0)
    first.add_line(first.part_at(recording.PART_SECONDS), "frames.jsonl", "first\n")
    first.close()
    second.close()
    assert (folder / "part-001" / "frames.jsonl").read_text() == "second\n"
    assert (folder / "part-002" / "frames.jsonl").read_text() == "first\n"


def test_a_camera_whose_clock_is_far_behind_is_recorded_whole(tmp_path: Path) -> None:
    """The clocks of the rig can be mended afterwards, and what was not stored cannot."""
    folder, kept = tmp_path / "take", begun(tmp_path)
    for name, shift in (("a", 5000.0), ("b", 5000.0), ("c", 100.0)):
        film = coded_film("libx264", range(24), g="6", bf="0")
        record(kept.camera(name, NO_FAULTS), film, shift_seconds=shift)
    kept.close()
    with pytest.raises(CaptureError, match=r"'c' ends with the instant -4889.* share one clock"):
        open_capture(folder)
    text = (folder / "capture.json").read_text()
    (folder / "capture.json").write_text(text.replace('"offset_seconds": -4900.0', '"offset_seconds": 0.0'))
    frames = list(open_capture(folder).frames())
    assert [sorted(frame.images) for frame in frames] == [list(NAMES)] * 24


def test_recorded_pictures_keep_their_times_where_packets_do_not_say_when_they_are_decoded(tmp_path: Path) -> None:
    """As the first ones of RTSP and Matroska with B-frames, which come before those that are shown before them."""
    params = "keyint=12:scenecut=0:b-adapt=0:bframes=3"
    film, kept = coded_film("libx264", range(24), form="matroska", **{"x264-params": params}), begun(tmp_path)
    with av.open(io.BytesIO(film), "r") as container:
        assert any(packet.dts is None for packet in container.demux(video=0) if packet.size)
    record(kept.camera("a", NO_FAULTS), film)
    kept.close()
    with av.open(str(tmp_path / "take" / "a.ts")) as container:
        times = [frame.time for frame in container.decode(video=0)]
    assert np.diff(times) == pytest.approx(np.full(23, 1 / FPS), abs=2e-3)


def test_a_recording_that_cannot_be_written_does_not_end_the_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(self: object, number: int, file: str, line: str) -> None:
        raise StorageError("no room")

    monkeypatch.setattr(recording.Recording, "add_line", full)
    assert len(list(live(files(tmp_path), record=tmp_path / "take", frames=4).frames())) == 4
    assert "camera 'b' is no longer recorded (no room); the stream goes on" in caplog.text


def test_a_recording_that_cannot_be_ended_does_not_end_the_others(caplog: pytest.LogCaptureFixture) -> None:
    class Full:
        def close(self) -> None:
            raise OSError(28, "No space left on device")

    recorder = recording.CameraRecorder(None, "b", FaultLog("rig", now=lambda: 0.0))  # type: ignore[arg-type]
    recorder._output = Full()
    recorder.close()
    recorder.close()
    assert caplog.text.count("camera 'b' is no longer recorded (No space left on device); the stream goes on") == 1


def test_a_camera_whose_colours_cannot_be_converted_is_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def converted(frame: Any, *rest: Any, width: int, height: int) -> Any:
        if width == 64:
            raise ValueError("no such format")
        return srgb(frame, *rest, width=width, height=height)

    monkeypatch.setattr(source_module, "srgb", converted)
    source = live(files(tmp_path))
    source._sizes["b"] = 64, 48
    shot = av.VideoFrame.from_ndarray(moving_pictures()[0], format="rgb24").reformat(format="yuv420p")
    pictures = {name: LivePicture(0.5, 0.0, shot) for name in NAMES}
    assert [*source._converted(PictureSet(0.5, pictures, 0.0)).images] == ["a", "c"]
    assert "camera 'b' sends pictures whose colours cannot be converted (no such format)" in caplog.text
    assert source.faults.counts["b"] == {"garbage": 1}


@pytest.mark.parametrize(
    ("existing", "parts"), [("take/a.ts", ["part-001", "part-002"]), ("take/part-003/a.ts", ["part-004"])]
)
def test_a_recording_replaces_nothing(
    tmp_path: Path, existing: str, parts: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Not even the film of its own cameras, or an earlier recording."""
    path, folder, film = files(tmp_path), tmp_path / "take", tmp_path / existing
    film.parent.mkdir(parents=True)
    (tmp_path / "a.ts").rename(film)
    path.write_text(path.read_text().replace('"a.ts"', f'"{existing}"'))
    before = film.read_bytes()
    for part in parts:
        list(live(path, record=folder, frames=6).frames())
        assert len(open_capture(folder / part)) >= 5
        assert f"{folder} is not empty; the recording goes to {folder / part}" in caplog.text
    assert film.read_bytes() == before


def test_options_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    path = files(tmp_path)
    with pytest.raises(ConfigError, match="scale"):
        live(path, scale=2.0)
    path.write_text(path.read_text().replace("[cameras.c]", "[cameras.d]"))
    with pytest.raises(CaptureError, match="names camera 'd'"):
        live(path)


@pytest.mark.parametrize("clock", ["stream", "arrival"])
def test_the_sound_of_a_camera_is_in_step_with_the_pictures(tmp_path: Path, clock: str) -> None:
    """A clap is filmed half a second after the film's first picture; sets that are skipped leave no gap."""
    path = files(tmp_path)
    path.write_text(path.read_text().replace('"stream"', f'"{clock}"'))
    with av.open(str(tmp_path / "b.ts")) as container:
        first = next(frame.time for frame in container.decode(video=0))
    assert first is not None
    add_sound(tmp_path / "b.ts", tmp_path / "heard.ts", claps(1.0, 0.5), start=first)
    (tmp_path / "heard.ts").replace(tmp_path / "b.ts")
    source = live(path, sound="b", denoising=DenoisingConfig(frames=1))
    assert source.sound is not None
    feed, packets, expected = source.sound.open(), [], []
    for frame in source.frames():
        packets += feed.until(frame.pts_seconds + 1 / FPS)
        expected.append(frame.pts_seconds + 0.5 - number_shown(frame.images["b"]) / FPS)
        time.sleep(0.1)
    packets += feed.until(10.0)
    times = [packet.seconds for packet in packets]
    assert np.diff(times) == pytest.approx(PACKET_SECONDS)
    (heard,) = packets_heard(packets)
    loop = len(moving_pictures()) / FPS
    apart = [(one - heard + loop / 2) % loop - loop / 2 for one in expected]
    assert np.abs(apart).max() < 0.5 / FPS + 0.003, "a set has pictures of up to half a frame from its instant"


def test_a_camera_that_sends_no_sound_is_said_and_one_that_is_not_there_refused(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = files(tmp_path, frames=5)
    with pytest.raises(ConfigError, match="has no camera 'z' whose sound could be stored; it has a, b, c"):
        live(path, sound="z")
    source = live(path, sound="b")
    assert len(list(source.frames())) > 0
    assert sum("sends no sound, which --sound asks for" in record.message for record in caplog.records) == 1


def prepared(folder: Path) -> PreparedCapture:
    """A prepared capture of one lens that distorts, whose videos are not there."""
    rig = small_rig()
    cameras = {
        name: PreparedCamera(f"{name}.mp4", LensCamera(rig[name], RadialTangential(k1=k1)), rig[name])
        for name, k1 in zip(rig, (0.0, -0.15, 0.0, 0.0), strict=True)
    }
    capture = PreparedCapture(cameras, 25.0, 0.1, held_out=frozenset([next(iter(rig))]))
    write_prepared(folder, capture)
    return capture


def test_pictures_are_undistorted_as_those_of_the_capture(tmp_path: Path) -> None:
    capture, path = prepared(tmp_path), tmp_path / "rig.toml"
    filmed = filmed_rig(tmp_path, capture)
    path.write_text('calibration = "."\n' + "".join(f'[cameras.{name}]\nurl = "udp://{name}"\n' for name in filmed))
    random = np.random.default_rng(0)
    images = {
        name: random.integers(0, 256, (camera.height, camera.width, 3)).astype(np.uint8)
        for name, camera in filmed.cameras.items()
    }
    frames = [MultiViewFrame(0, 3.25, images, captured_unix_seconds=5.0)]
    source = live(path, near=0.3)
    (frame,) = source._calibrated(iter(frames)).frames()
    second = [*images][1]
    expected = Undistortion(capture.cameras[second].filmed, capture.cameras[second].pinhole)(images[second])
    assert (frame.images[second] == expected).all()
    assert (expected != images[second]).any()
    assert (frame.pts_seconds, frame.captured_unix_seconds) == (3.25, 5.0)
    assert source.rig[second].near == 0.3
    half = live(path, held_out=(second,), scale=0.5)
    assert half.rig.testing == (second,)
    (small,) = half._calibrated(iter(frames)).frames()
    assert small.images[second].shape == (half.rig[second].height, half.rig[second].width, 3)
    assert half.rig[second].width == round(filmed[second].width / 2)


def test_a_capture_of_another_layout_gives_its_rig() -> None:
    capture = read_calibration(bundled_clip_path())
    clip = bundled_clip()
    assert capture.held_out == clip.rig.held_out
    assert capture.near == pytest.approx(clip.rig["cam03"].near)
    chosen = capture.only(["cam02", "cam01", "cam05"])
    assert [*chosen.cameras] == ["cam01", "cam02", "cam05"]
    assert chosen.held_out == frozenset()
    rig = filmed_rig(bundled_clip_path(), capture)
    assert (rig["cam03"].K == clip.rig["cam03"].K).all()
    assert (rig["cam03"].viewmat == clip.rig["cam03"].viewmat).all()
