# SPDX-License-Identifier: Apache-2.0
"""The sound of a video, on the clock of its pictures."""

from pathlib import Path

import av
import numpy as np
import pytest

from structgstream.data import sound as audio
from structgstream.data.sound import read_audio
from structgstream.errors import CaptureError
from tests.support.captures import write_video

RATE = 48_000


def with_sound(path: Path, *, start: float = 0.0, rate: int = RATE, seconds: float = 1.0, layout: str = "mono") -> Path:
    """A video whose sound, a click in its middle, begins at ``start`` seconds."""
    samples = np.zeros(round(rate * seconds), np.float32)
    samples[len(samples) // 2] = 0.9
    with av.open(str(path), "w") as container:
        video = container.add_stream("mpeg4", rate=30)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        sound = container.add_stream("aac" if path.suffix == ".ts" else "pcm_f32le", rate=rate)
        sound.layout = layout
        for index in range(5):
            picture = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
            picture.pts = index
            container.mux(video.encode(picture))
        container.mux(video.encode(None))
        stored = np.repeat(samples, 1 if layout == "mono" else 2)[None]
        frame = av.AudioFrame.from_ndarray(stored, format="flt", layout=layout)
        frame.sample_rate, frame.pts = rate, round(start * rate)
        container.mux(sound.encode(frame))
        container.mux(sound.encode(None))
    return path


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


def test_a_video_without_sound(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [np.zeros((48, 64, 3), np.uint8)] * 2)
    assert read_audio(tmp_path / "a.mp4") is None


def test_a_very_long_one_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audio, "LONGEST_SECONDS", 0.9)
    with pytest.raises(CaptureError, match=r"a\.mkv is longer than two hours; cut it to the take"):
        read_audio(with_sound(tmp_path / "a.mkv"))


def test_what_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_text("no video")
    with pytest.raises(CaptureError, match=r"sound of .*a\.mp4 cannot be read"):
        read_audio(tmp_path / "a.mp4")


def test_sound_whose_channels_change(tmp_path: Path) -> None:
    """As recordings of broadcasts have it."""
    parts = [with_sound(tmp_path / f"{layout}.ts", layout=layout).read_bytes() for layout in ("mono", "stereo")]
    (tmp_path / "a.ts").write_bytes(b"".join(parts))
    with pytest.raises(CaptureError, match=r"sound of .*a\.ts cannot be decoded \(Frame does not match"):
        read_audio(tmp_path / "a.ts")
