# SPDX-License-Identifier: Apache-2.0
"""Sound in presentation time: clocks, rates, channels, gaps, and what is missing; a clap is off by 1 ms at most. And as
samples, on the clock of a video's pictures."""

from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.codec.packets import Packet, PacketKind
from structgstream.codec.sound import unpack_sound
from structgstream.data import sound as audio
from structgstream.data.open import open_capture
from structgstream.data.sound import LiveSound, SoundEncoder, SoundFile, camera_clock, read_audio, start_seconds
from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.opus import PACKET_SECONDS, OpusPacket
from structgstream.recorder import SoundSink
from tests.support.captures import write_video
from tests.support.quick_streams import CLIP
from tests.support.sounds import add_sound, claps, packets_heard, write_sound

MILLISECOND = 1e-3


def sound_frame(samples: NDArray[np.float32]) -> av.AudioFrame:
    frame = av.AudioFrame.from_ndarray(samples, format="fltp", layout="mono")
    frame.sample_rate = 48_000
    return frame


def heard(path: Path, clock: Clock, seconds: float) -> tuple[list[OpusPacket], list[float]]:
    feed = SoundFile("it", path, clock).open()
    packets = feed.until(seconds)
    return packets, packets_heard(packets, channels=feed.channels)


@pytest.mark.parametrize("rate", [8_000, 16_000, 44_100, 48_000, 96_000])
@pytest.mark.parametrize("channels", [1, 2, 6])
def test_any_rate_and_number_of_channels(tmp_path: Path, rate: int, channels: int) -> None:
    path = write_sound(tmp_path / "a.wav", claps(2.0, 0.5, 1.25, rate=rate, channels=channels), rate=rate)
    assert SoundFile("it", path, Clock()).open().channels == min(channels, 2)
    _, found = heard(path, Clock(), 2.0)
    assert found == pytest.approx([0.5, 1.25], abs=MILLISECOND)


@pytest.mark.parametrize("offset", [-0.3, 0.0, 0.0137, 2.5])
def test_a_clock_s_offset_shifts_it(tmp_path: Path, offset: float) -> None:
    path = write_sound(tmp_path / "a.wav", claps(2.0, 0.5, 1.25))
    packets, found = heard(path, Clock(offset), 5.0)
    assert packets[0].seconds == pytest.approx(-312 / 48_000)
    assert np.diff([packet.seconds for packet in packets]) == pytest.approx(PACKET_SECONDS)
    assert found == pytest.approx([0.5 + offset, 1.25 + offset], abs=MILLISECOND)


@pytest.mark.parametrize(("rate", "seconds"), [(1 + 8e-5, 600.0), (1 - 2e-4, 60.0)])
def test_it_is_in_step_after_minutes_whatever_the_clock_s_rate(tmp_path: Path, rate: float, seconds: float) -> None:
    at = [0.5, seconds / 2, seconds - 1.0]
    path = write_sound(tmp_path / "a.flac", claps(seconds, *at))
    _, found = heard(path, Clock(0.1, rate), seconds + 1.0)
    assert found == pytest.approx([0.1 + rate * one for one in at], abs=MILLISECOND)


def test_packets_do_not_depend_on_how_they_are_asked_for(tmp_path: Path) -> None:
    path = write_sound(tmp_path / "a.wav", claps(3.0, 0.5, 2.25))
    whole, _ = heard(path, Clock(0.01), 3.0)
    feed = SoundFile("it", path, Clock(0.01)).open()
    parts = [feed.until(end / 30) for end in range(1, 91)]
    assert [packet for part in parts for packet in part] == whole
    assert all(packet.seconds < end / 30 for end, part in enumerate(parts, 1) for packet in part)


def test_a_gap_in_the_time_stamps_is_silence_and_what_comes_twice_is_left_out() -> None:
    encoder, packets = SoundEncoder(1), list[OpusPacket]()
    for seconds in (0.0, 0.5, 0.55, 1.0):
        packets += encoder.add(sound_frame(claps(0.1, 0.05)), seconds)
    packets += encoder.finish()
    # The third begins with what the second ends with.
    assert packets_heard(packets) == pytest.approx([0.05, 0.55, 1.05], abs=MILLISECOND)


@pytest.mark.parametrize("first", [1.0, 0.51])
def test_a_shorter_sound_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture, first: float) -> None:
    """Also where the frame that asks for the last packet ends with them."""
    feed = SoundFile("cam", write_sound(tmp_path / "a.wav", claps(0.5, 0.2)), Clock()).open()
    assert len(feed.until(first)) == 26
    assert feed.until(2.0) == feed.until(3.0) == []
    assert [record.message for record in caplog.records] == [
        "The sound of cam ends at 0.5 s, before the pictures; what follows is silent"
    ]


def test_a_damaged_end_is_said_and_costs_nothing_else(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_sound(tmp_path / "a.flac", claps(3.0, *np.arange(0.25, 3.0, 0.25)))
    path.write_bytes(path.read_bytes()[:-2000])
    packets, found = heard(path, Clock(), 3.0)
    assert packets[-1].seconds < 2.9
    assert found[0] == pytest.approx(0.25, abs=MILLISECOND)
    assert len(caplog.records) == 1


def test_files_without_sound(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [np.zeros((48, 64, 3), np.uint8)] * 2)
    with pytest.raises(CaptureError, match=r"a\.mp4 has no sound; choose another"):
        SoundFile("a", tmp_path / "a.mp4", Clock()).open()
    assert read_audio(tmp_path / "a.mp4") is None
    (tmp_path / "b.mp4").write_text("no video")
    for name in ("missing.wav", "b.mp4"):
        with pytest.raises(CaptureError, match=f"The sound of .*{name} cannot be read"):
            SoundFile("a", tmp_path / name, Clock()).open()


def test_a_camera_s_clock_is_that_of_its_pictures(tmp_path: Path) -> None:
    """The bundled clip with a camera that began a third of a second earlier, by its own time stamps."""
    folder = tmp_path / "clip"
    folder.mkdir()
    for file in Path(CLIP).iterdir():
        (folder / file.name).symlink_to(file)
    (folder / "cam03.mp4").unlink()
    add_sound(Path(CLIP) / "cam03.mp4", folder / "cam03.mp4", claps(0.4, 0.2))
    source = open_capture(folder)
    assert camera_clock(source, "cam03") == (folder / "cam03.mp4", Clock(0.0, 1.0))
    later = open_capture(folder, start=3, frames=6, scale=0.5)
    found = camera_clock(later, "cam03")
    assert found is not None
    assert found[1].offset_seconds == pytest.approx(-0.1)
    assert start_seconds(later) == pytest.approx(-0.1)
    _, at = heard(folder / "cam03.mp4", found[1], 0.4)
    assert at == pytest.approx([0.1], abs=MILLISECOND)
    assert camera_clock(open_capture(folder, every=2), "cam03") == (folder / "cam03.mp4", Clock(0.0, 1.0))


def test_a_live_stream_that_is_resumed_hears_nothing_twice() -> None:
    """The camera is heard half a second before the first frame, which follows the last one that is there."""
    written: list[Packet] = []
    live = LiveSound("cam")
    sink = SoundSink(SimpleNamespace(write=written.append), live, fps=25.0, after=2.0)  # pyright: ignore[reportArgumentType]
    live.add(sound_frame(claps(1.0)), 101.54)
    live.synchronize(100.0)
    sink.write(Packet(PacketKind.KEY, 51, 2.04, b"", {}))
    assert written[0].sound is not None
    sound = unpack_sound(written[0].sound)
    assert sound.seconds == pytest.approx(2.04, abs=PACKET_SECONDS)
    assert sound.seconds >= 2.04
    assert len(sound.packets) == 2


def test_live_sound_is_in_step_with_the_pictures_and_begins_again_after_an_outage() -> None:
    sound = LiveSound("cam")
    feeds = [sound.open(), sound.open()]

    def send(first: float, seconds: float) -> None:
        sound.add(sound_frame(claps(seconds, seconds / 2)), first)

    send(99.0, 0.5)  # before the first picture
    send(99.9, 0.4)
    sound.synchronize(100.0)
    send(100.3, 0.3)
    early = feeds[0].until(0.3)
    assert packets_heard(early) == pytest.approx([0.1], abs=MILLISECOND)
    assert packets_heard(early + feeds[0].until(10.0)) == pytest.approx([0.1, 0.45], abs=MILLISECOND)
    assert packets_heard(feeds[1].until(10.0)) == pytest.approx([0.1, 0.45], abs=MILLISECOND)
    sound.synchronize(100.0)
    send(200.0, 1.0)
    after = feeds[0].until(200.0)
    gap = [one.seconds for one in after if one.seconds > 90.0]
    assert gap[0] == pytest.approx(100.0, abs=0.03)
    assert packets_heard([one for one in after if one.seconds > 90.0]) == pytest.approx([100.5], abs=MILLISECOND)


RATE = 48_000


def with_sound(path: Path, *, start: float = 0.0, rate: int = RATE, channels: int = 1) -> Path:
    """A video whose sound, a second with a click in its middle, begins at ``start`` seconds."""
    samples = np.zeros((channels, rate), np.float32)
    samples[:, rate // 2] = 0.9
    write_video(path.with_suffix(".mp4"), [np.zeros((48, 64, 3), np.uint8)] * 5)
    codec = "aac" if path.suffix == ".ts" else "pcm_f32le"
    return add_sound(path.with_suffix(".mp4"), path, samples, rate=rate, start=start, codec=codec)


@pytest.mark.parametrize("start", [0.0, 0.25])
def test_sample_k_sounds_at_k_over_the_rate(tmp_path: Path, start: float) -> None:
    samples = read_audio(with_sound(tmp_path / "a.mkv", start=start))
    assert samples is not None
    assert samples.dtype == np.float32
    assert int(np.abs(samples).argmax()) == pytest.approx((start + 0.5) * RATE, abs=60)  # Matroska keeps milliseconds
    assert len(samples) == pytest.approx((start + 1.0) * RATE, abs=60)
    assert not samples[: round(start * RATE) - 60 if start else 0].any()


def test_gaps_in_the_time_stamps_are_silence_and_what_comes_twice_is_left_out(tmp_path: Path) -> None:
    """Recorders of streams lose packets, and send some again."""
    block = RATE // 10
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        sound = container.add_stream("pcm_f32le", rate=RATE)
        sound.layout = "mono"
        for number in (0, 1, 5, 5, 6):  # tenths of a second
            frame = av.AudioFrame.from_ndarray(np.full((1, block), 0.1 * number, np.float32), "flt", "mono")
            frame.sample_rate, frame.pts = RATE, number * block
            container.mux(sound.encode(frame))
    samples = read_audio(tmp_path / "a.mkv")
    assert samples is not None
    np.testing.assert_allclose(samples.reshape(7, block)[:, block // 2], [0, 0.1, 0, 0, 0, 0.5, 0.6], atol=1e-6)


def test_another_rate_is_converted(tmp_path: Path) -> None:
    samples = read_audio(with_sound(tmp_path / "a.mkv", rate=16_000))
    assert samples is not None
    assert int(np.abs(samples).argmax()) == pytest.approx(0.5 * RATE, abs=60)


def test_a_very_long_one_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audio, "LONGEST_SECONDS", 0.9)
    with pytest.raises(CaptureError, match=r"a\.mkv is longer than two hours; cut it to the take"):
        read_audio(with_sound(tmp_path / "a.mkv"))


def test_sound_whose_channels_change(tmp_path: Path) -> None:
    """As recordings of broadcasts have it."""
    parts = [with_sound(tmp_path / f"{channels}.ts", channels=channels).read_bytes() for channels in (1, 2)]
    (tmp_path / "a.ts").write_bytes(b"".join(parts))
    with pytest.raises(CaptureError, match=r"sound of .*a\.ts cannot be decoded \(Frame does not match"):
        read_audio(tmp_path / "a.ts")
