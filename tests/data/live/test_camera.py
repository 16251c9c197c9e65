# SPDX-License-Identifier: Apache-2.0
"""One camera whose stream is in memory: what is delivered of it, with every fault.

Times of pictures from stamps that jump, repeat, go back, wrap, drift and come late: synthetic time.
"""

import io
import itertools
import socket
import threading
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import av.error
import numpy as np
import pytest
from av.codec.context import Flags
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.live.camera import MAX_UNSTAMPED, CameraFeed, ClockMapper, ClockResets, PictureTime
from structgstream.data.live.rig_file import LiveCamera, LiveRig, TimeBase
from structgstream.data.live.status import Fault, FaultLog
from structgstream.data.live.synchronizer import LivePicture
from structgstream.data.sound import LiveSound
from tests.support.properties import examples
from tests.support.sender_modules import coded_film, moving_pictures, number_shown, sent_stream
from tests.support.waiting import wait_until

WAIT = 20.0
PERIOD = 1 / 30
NOWHERE = LiveCamera("udp://user:secret@nowhere")


class Received:
    """Notes what a camera delivers."""

    def __init__(self, changed_at: float = -np.inf) -> None:
        self.pictures: list[LivePicture] = []
        self.losses = 0
        self.waits: list[float] = []
        self.changed_at = {"another": changed_at}

    def add(self, camera: str, picture: LivePicture) -> None:
        self.pictures.append(picture)

    def mark_absent(self, camera: str) -> None:
        self.losses += 1

    @property
    def numbers(self) -> list[int]:
        """Which pictures of the film they are, by their content."""
        return [number_shown(picture.content.to_ndarray(format="rgb24")) for picture in self.pictures]

    @property
    def steps(self) -> list[int]:
        """Pictures from one to the next, by their times."""
        times = [picture.seconds for picture in self.pictures]
        return [round((b - a) / PERIOD) for a, b in itertools.pairwise(times)]


def clock(base: TimeBase, *, offset_seconds: float = 0.0) -> ClockMapper:
    """The clock of a camera alone."""
    return ClockMapper(base, resets=ClockResets(), offset_seconds=offset_seconds)


def camera_feed(
    received: Received,
    *,
    base: TimeBase,
    camera: LiveCamera = NOWHERE,
    tick: float = PERIOD / 2,
    unix_offset: float = 1000.0,
    **options: Any,
) -> tuple[CameraFeed, FaultLog]:
    """A camera of 128x96 pixels in a time of its own, ``tick`` seconds later each time it is read, and its faults."""
    ticks, faults = itertools.count(), FaultLog("rig", now=lambda: 0.0)
    feed = CameraFeed(
        "a",
        LiveRig("rig", Path(), {"a": camera}, clock=base, stuck_seconds=1.0),
        size=(128, 96),
        synchronizer=received,  # type: ignore[arg-type]
        changed_at=received.changed_at,
        resets=ClockResets(),
        faults=faults,
        now=lambda: next(ticks) * tick,
        unix_offset=unix_offset,
        **options,
    )
    return feed, faults


def read(
    *streams: bytes | Exception,
    base: TimeBase = TimeBase.STREAM,
    form: str | None = None,
    changed_at: float = -np.inf,
    **options: Any,
) -> tuple[Received, dict[str, int]]:
    """What a camera delivers that is opened for each of ``streams``, and its faults; another one last changed at
    ``changed_at``."""
    received, waiting = Received(changed_at), list(streams)

    def opens(camera: LiveCamera, timeout: float) -> Any:
        stream = waiting.pop(0)
        if isinstance(stream, Exception):
            raise stream
        return av.open(io.BytesIO(stream), format=form)

    def wait(seconds: float) -> None:
        received.waits.append(seconds)
        if not waiting:
            feed.stop()

    feed, faults = camera_feed(received, base=base, open_camera=opens, wait=wait, **options)
    feed.start()
    feed.join(WAIT)
    return received, faults.counts.get("a", {})


def test_a_clean_stream_is_delivered_whole() -> None:
    received, faults = read(sent_stream())
    assert received.numbers == [n % 12 for n in range(60)]
    assert received.steps == [1] * 59
    assert received.pictures[0].seconds == pytest.approx(1000.0, abs=1e-4)
    assert faults == {"gone": 1}


def test_a_stream_that_is_joined_late_begins_with_a_key_frame_and_tells_nothing() -> None:
    received, faults = read(sent_stream()[188 * 40 :])
    assert received.numbers[0] == 0
    assert faults == {"gone": 1}


def test_of_garbage_nothing_is_delivered_until_the_next_key_frame(caplog: pytest.LogCaptureFixture) -> None:
    received, faults = read(sent_stream("garbage:0.5:0.2"))
    lost = set(range(60)) - {round((p.seconds - 1000) / PERIOD) for p in received.pictures}
    assert set(range(15, 21)) <= lost <= set(range(14, 25))  # up to the key frame 24
    assert received.numbers == [n % 12 for n in range(60) if n not in lost]
    assert faults["garbage"] >= 1
    assert received.losses >= 1
    assert sum("until its next key frame" in record.getMessage() for record in caplog.records) == 1


def test_lost_datagrams_are_a_damage() -> None:
    stream = sent_stream()
    middle = len(stream) // 2 // 188 * 188
    received, faults = read(stream[:middle] + stream[middle + 188 * 3 :])
    assert received.numbers == [n % 12 for n in (round((p.seconds - 1000) / PERIOD) for p in received.pictures)]
    assert faults["garbage"] >= 1
    assert 40 <= len(received.pictures) < 60


class Packets:
    """Notes what is to be recorded of a camera."""

    def __init__(self) -> None:
        self.found: list[tuple[Any, float]] = []

    def record(self, packet: Any, *, shift_seconds: float) -> None:
        self.found.append((packet, shift_seconds))

    def shown(self) -> Received:
        """Its pictures, decoded again, at the times of their packets."""
        received, decoder = Received(), av.CodecContext.create("h264", "r")
        seconds = {packet.pts: float(packet.pts * packet.time_base) + shift for packet, shift in self.found}
        for packet in (*(packet for packet, _ in self.found), None):
            for frame in decoder.decode(packet):  # type: ignore[attr-defined]
                received.add("a", LivePicture(seconds[frame.pts], 0.0, frame))
        return received


def with_b_frames(x264: str, first: int = 0) -> bytes:
    """Five groups of 12 pictures of the film from number ``first`` on."""
    params = f"keyint=12:min-keyint=12:scenecut=0:b-adapt=0:{x264}"
    return coded_film("libx264", range(first, first + 60), **{"x264-params": params})


@pytest.mark.parametrize("base", [TimeBase.STREAM, TimeBase.ARRIVAL])
@pytest.mark.parametrize("x264", ["bframes=0", "bframes=3", "bframes=3:open-gop=1"])
def test_what_is_recorded_after_a_loss_begins_with_a_key_frame(x264: str, base: TimeBase) -> None:
    """Decoders give pictures back some packets later, where B-frames refer to pictures after them."""
    stream, packets = with_b_frames(x264), Packets()
    middle = len(stream) // 3 // 188 * 188
    cut = stream[:middle] + stream[middle + 188 * 3 :]
    received, _ = read(cut, with_b_frames(x264, first=240), base=base, recorder=packets)
    recorded = packets.shown()
    assert 90 < len(recorded.pictures) < 120
    if base is TimeBase.STREAM:
        assert len(recorded.pictures) <= len(received.pictures) < 120
        first = recorded.pictures[0].seconds
        assert recorded.numbers == [round((one.seconds - first) / PERIOD) % 12 for one in recorded.pictures]
        assert {one.seconds for one in recorded.pictures} <= {one.seconds for one in received.pictures}
    else:
        assert len(recorded.numbers) == len(recorded.pictures)
        assert all(np.isfinite(shift) for _, shift in packets.found)


@pytest.mark.parametrize(
    ("fault", "taken", "said"),
    [
        ("shape", {(128, 96)}, "64x96 pixels, its calibration is for 128x96"),
        ("size", {(128, 96), (64, 48)}, "it is resampled"),
    ],
)
def test_a_picture_of_other_proportions_is_left_out_and_a_reduced_one_is_taken(
    fault: str, taken: set[tuple[int, int]], said: str, caplog: pytest.LogCaptureFixture
) -> None:
    received, faults = read(sent_stream(f"{fault}:0.8:0.4"))
    assert {(p.content.width, p.content.height) for p in received.pictures} == taken
    assert faults["other size"] == 12
    assert said in caplog.text


@pytest.mark.parametrize("still", [True, False])
def test_a_picture_that_stands_still_is_left_out_if_others_change(still: bool) -> None:
    received, faults = read(sent_stream("stuck:0.4:1.2"), changed_at=-np.inf if still else 1e9)
    if still:
        assert "stuck" not in faults
        assert len(received.pictures) >= 57  # another muxer's first packets do not follow the ones before
    else:
        assert faults["stuck"] >= 30
        assert len(received.pictures) <= 60 - faults["stuck"]
        assert received.losses >= 30
        assert received.numbers[-6:] == [6, 7, 8, 9, 10, 11]


@pytest.mark.parametrize("fault", ["jump", "back"])
def test_a_clock_that_is_set_is_reported_and_the_pictures_go_on(fault: str, caplog: pytest.LogCaptureFixture) -> None:
    received, faults = read(sent_stream(f"{fault}:0.8:0.4"))
    assert faults["jump"] == 2
    assert len(received.pictures) == 60
    times = [p.seconds for p in received.pictures]
    assert max(times) - min(times) < 5.0
    assert "has set its clock by " + ("+" if fault == "jump" else "-") in caplog.text


def test_sound_with_the_stamps_of_a_clock_that_pictures_do_not_have_yet_is_left_out() -> None:
    """A camera sets its clock by an hour, and sound is the first to have it; later sound is heard all the same."""
    sound = LiveSound("a")
    feed = sound.open()
    received, _ = read(with_hasty_sound(sent_stream()), sound=sound)
    sound.synchronize(received.pictures[0].seconds)
    times = [packet.seconds for packet in feed.until(3600.0)]
    assert times[-1] == pytest.approx(1.9, abs=0.2)
    assert np.diff(times) == pytest.approx(0.02)


def with_hasty_sound(video: bytes) -> bytes:
    """The same MPEG-TS with sound; the stamps are an hour later from 1 s on, those of sound from 0.9 s on."""
    output = io.BytesIO()
    container: Any
    given: Any
    with av.open(io.BytesIO(video)) as given, av.open(output, "w", format="mpegts") as container:
        pictures = container.add_stream_from_template(given.streams.video[0])
        stream = container.add_stream("aac", rate=48_000, layout="mono")
        packets = [packet for packet in given.demux(given.streams.video[0]) if packet.size]
        first = float(packets[0].pts * packets[0].time_base)
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 96_000), np.float32), format="fltp", layout="mono")
        silence.sample_rate, silence.pts, silence.time_base = 48_000, round(first * 48_000), Fraction(1, 48_000)
        packets += [*stream.encode(silence), *stream.encode(None)]
        for packet in sorted(packets, key=lambda one: one.pts * one.time_base):
            is_sound = packet.stream is stream
            if float(packet.pts * packet.time_base) - first >= (0.9 if is_sound else 1.0):
                later = round(3600 / packet.time_base)
                packet.pts, packet.dts = packet.pts + later, packet.dts + later
            packet.stream = stream if is_sound else pictures
            container.mux(packet)
    return output.getvalue()


def test_of_two_pictures_with_one_stamp_the_first_is_taken() -> None:
    """The second is not decoded either: differences that are added twice smear what follows."""
    received, faults = read(sent_stream("duplicate:0.4:0.4"))
    assert faults["duplicate"] == 12
    assert received.numbers == [n % 12 for n in range(60)]
    assert received.steps == [1] * 59


def test_stamps_that_go_back_are_left_out() -> None:
    received, faults = read(sent_stream("reorder:0.4:0.4"))
    assert faults["reordered"] >= 3
    times = [p.seconds for p in received.pictures]
    assert times == sorted(set(times))
    assert len(times) == 60 - faults["reordered"] - faults.get("duplicate", 0)


def test_a_camera_that_ends_or_cannot_be_opened_is_opened_again(caplog: pytest.LogCaptureFixture) -> None:
    refused = ConnectionRefusedError(111, "Connection refused")
    streams = [sent_stream(frames=24), *[refused] * 6, sent_stream(frames=24, begun=1000.8)]
    received, faults = read(*streams)
    assert faults == {"gone": 8}
    assert received.numbers == [n % 12 for n in range(24)] * 2
    assert received.steps == [1] * 47
    assert received.waits == [0.5, 1.0, 2.0, 4.0, 8.0, 8.0, 8.0, 0.5]
    assert "udp://nowhere is gone (it ended)" in caplog.text
    assert "is back after" in caplog.text


def test_an_error_of_the_network_is_reported_in_words(caplog: pytest.LogCaptureFixture) -> None:
    read(av.error.ExitError(1414092869, "Immediate exit requested", "udp://nowhere"))
    assert "is gone (nothing came for 5 s)" in caplog.text


def test_an_error_that_nobody_expects_is_reported_and_the_camera_is_opened_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    received, faults = read(RuntimeError("what is this?"), sent_stream(frames=24))
    assert received.numbers == [*range(12), *range(12)]
    assert faults["gone"] == 2
    assert "is gone (RuntimeError: what is this?)" in caplog.text


def test_what_is_no_video_is_gone() -> None:
    received, faults = read(np.random.default_rng(0).bytes(20_000))
    assert received.pictures == []
    assert faults == {"gone": 1}


@pytest.mark.parametrize("base", [TimeBase.ARRIVAL, TimeBase.STREAM])
def test_pictures_without_stamps(base: TimeBase, caplog: pytest.LogCaptureFixture) -> None:
    """The first ones of a connection wait for stamps; a camera that has none is timed by arrival, if that is asked."""
    feed, faults = camera_feed(Received(), base=base)
    frames = [SimpleNamespace(pts=None, time_base=None)] * 60
    placed = [feed._common_time(frame, n * PERIOD).seconds for n, frame in enumerate(frames)]  # type: ignore[arg-type]
    assert placed[:MAX_UNSTAMPED] == [None] * MAX_UNSTAMPED
    assert faults.counts["a"] == {"no stamp": 60}
    if base is TimeBase.ARRIVAL:
        steps = np.diff(np.array(placed[MAX_UNSTAMPED:], np.float64))
        assert np.allclose(steps, PERIOD)
    else:
        assert placed == [None] * 60
        assert 'take clock = "arrival"' in caplog.text
    stamped = SimpleNamespace(pts=90, time_base=1)
    assert feed._common_time(stamped, 61 * PERIOD).seconds is not None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("progressive", None),
        ("interlaced", "interlaced pictures, whose lines are of two instants"),
        ("turned", "turned or mirrored to be shown"),
    ],
)
def test_interlaced_and_turned_pictures_are_left_out_as_recordings_refuse_or_turn_them(
    how: str, said: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    written = io.BytesIO()
    with av.open(written, "w", format="mp4") as output:
        params = "tff=1" if how == "interlaced" else ""
        stream: Any = output.add_stream("libx264", rate=30, options={"x264-params": params})
        stream.width, stream.height = 128, 96
        if how == "interlaced":
            stream.codec_context.flags |= Flags.interlaced_dct | Flags.interlaced_me
        if how == "turned":
            stream.set_display_rotation(180)
        for picture in moving_pictures():
            output.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        output.mux(stream.encode(None))
    received, faults = read(written.getvalue())
    assert len(received.pictures) == (12 if said is None else 0)
    assert faults.get("other size", 0) == (0 if said is None else 12)
    assert said is None or said in caplog.text


@pytest.mark.parametrize(
    ("form", "codec", "options"),
    [("mpjpeg", "mjpeg", {}), ("mjpeg", "mjpeg", {}), ("h264", "libx264", {"tune": "zerolatency"})],
)
@pytest.mark.parametrize("base", TimeBase)
def test_pictures_of_formats_without_stamps_are_taken_when_they_arrive(
    form: str, codec: str, options: dict[str, str], base: TimeBase
) -> None:
    """As web cameras send them, here five a second: what FFmpeg counts for them at 25 a second is no clock."""
    sent, packets = coded_film(codec, range(60), form=form, **options), Packets()
    received, faults = read(sent, base=base, form=form, tick=0.1, recorder=packets)
    if base is not TimeBase.ARRIVAL:
        assert not received.pictures
        assert faults["no stamp"] >= 55
        return
    assert len(received.pictures) >= 55
    assert np.ptp([one.seconds - one.arrived for one in received.pictures]) < 0.5
    recorded = [float(packet.pts * packet.time_base) + shift for packet, shift in packets.found]
    assert recorded == pytest.approx([one.seconds for one in received.pictures], abs=1e-5)


@pytest.mark.parametrize("stamp", [1000.0, 1.7e9])
def test_stamps_that_are_no_unix_time_are_told(stamp: float, caplog: pytest.LogCaptureFixture) -> None:
    """As those of most containers, which begin with 0."""
    feed, _ = camera_feed(Received(), base=TimeBase.UNIX)
    for number in range(3):
        frame: Any = SimpleNamespace(pts=stamp + number, time_base=1)
        assert feed._common_time(frame, 1.7e9 - 1000.0 + number).seconds == stamp + number
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == (0 if stamp == 1.7e9 else 1)
    assert all("sends time stamps 1699999000 s from the Unix time of this machine; set the" in text for text in said)


def sent_by_rtp(port: int, form: str, ended: threading.Event) -> None:
    """The film over and over, until the end."""
    with av.open(f"rtp://127.0.0.1:{port}", "w", format=form) as output:
        stream = output.add_stream("libx264", rate=30, options={"tune": "zerolatency", "g": "6"})
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        stream.options["x264-params"] = "repeat-headers=1"
        for number, picture in enumerate(itertools.cycle(moving_pictures())):
            if ended.wait(PERIOD):
                return
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = number
            output.mux(stream.encode(frame))


@pytest.mark.parametrize(
    ("form", "base"), [("rtp_mpegts", TimeBase.ARRIVAL), ("rtp_mpegts", TimeBase.UNIX), ("rtp", TimeBase.ARRIVAL)]
)
def test_a_camera_that_sends_rtp(tmp_path: Path, form: str, base: TimeBase) -> None:
    """MPEG-TS needs its address alone, and its stamps wrap; what else there is, a description of the session."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1] & ~1  # the next one is for reports
    (tmp_path / "a.sdp").write_text(
        f"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=a\nc=IN IP4 127.0.0.1\nt=0 0\nm=video {port} RTP/AVP 96\n"
        "a=rtpmap:96 H264/90000\na=fmtp:96 packetization-mode=1\n"
    )
    url = str(tmp_path / "a.sdp") if form == "rtp" else f"rtp://127.0.0.1:{port}"
    received, ended = Received(), threading.Event()
    feed, faults = camera_feed(received, base=base, camera=LiveCamera(url), tick=PERIOD, unix_offset=UNIX)
    sender = threading.Thread(target=sent_by_rtp, args=(port, form, ended))
    sender.start()
    feed.start()
    try:
        wait_until(lambda: len(received.pictures) >= 8)
    finally:
        ended.set()
        feed.stop()
        sender.join()
        feed.join(WAIT)
    numbers = received.numbers[:8]
    assert numbers == [(numbers[0] + n) % 12 for n in range(8)]
    assert all(abs(picture.seconds - UNIX) < WRAP for picture in received.pictures)
    assert not feed.ended
    assert "gone" not in faults.counts.get("a", {})


UNIX = 1_700_000_000.0
WRAP = 2**33 / 90_000


def mapped(mapper: ClockMapper, stamps, arrivals, **options) -> list[PictureTime]:
    return [mapper.map(stamp, arrived=at, **options) for stamp, at in zip(stamps, arrivals, strict=True)]


def placed(mapper: ClockMapper, stamps, arrivals, **options) -> list[Any]:
    return [found.seconds for found in mapped(mapper, stamps, arrivals, **options)]


def steps(found: list[PictureTime]) -> np.ndarray:
    return np.diff(np.array([item.seconds for item in found], np.float64))


def test_arrival_keeps_the_spacing_of_the_stamps_in_spite_of_jitter() -> None:
    """The least delay wins: after the first pictures, times lie where the quickest network would have put them."""
    stamps = np.arange(300) * PERIOD
    jitter = np.random.default_rng(0).uniform(0, 0.05, 300)
    times = placed(clock(TimeBase.ARRIVAL), stamps, UNIX + stamps + 0.02)
    assert times == pytest.approx(list(UNIX + stamps + 0.02), abs=1e-6)
    late = placed(clock(TimeBase.ARRIVAL), stamps, np.maximum.accumulate(UNIX + stamps + 0.02 + jitter))
    errors = np.array(late[60:]) - (UNIX + stamps + 0.02)[60:]
    assert errors.min() > -1e-6
    assert errors.max() < 0.005  # the least of 60 uniform values of 50 ms


def test_pictures_that_were_held_back_are_no_jump() -> None:
    """A server's buffer, or a stalled network: many pictures at once, which then are on time again."""
    stamps = np.arange(300) * PERIOD
    arrivals = np.maximum(UNIX + stamps, UNIX + np.where((stamps > 3) & (stamps < 7), 7, 0))
    arrivals = np.maximum.accumulate(arrivals + 1e-4 * np.arange(300))
    for base in (TimeBase.ARRIVAL, TimeBase.STREAM):
        found = mapped(clock(base), stamps, arrivals)
        assert [item.fault for item in found] == [None] * 300
        assert np.allclose(steps(found), PERIOD, atol=2e-4)


@pytest.mark.parametrize("cached", [0.5, 2.0, 5.0])
def test_the_backlog_at_the_beginning_of_a_connection_has_no_certain_time(cached: float) -> None:
    """A server sends at once what it has cached since the last key frame."""
    stamps = np.arange(300) * PERIOD
    arrivals = np.maximum(UNIX + stamps + 0.02, UNIX + cached + 1e-4 * np.arange(300))
    found = mapped(clock(TimeBase.ARRIVAL), stamps, arrivals)
    certain = np.array([item.certain for item in found])
    first = int(np.argmax(certain))
    assert first == pytest.approx(cached / PERIOD, abs=1.5)
    assert certain[first:].all()
    errors = np.array([item.seconds for item in found if item.certain]) - (UNIX + stamps + 0.02)[certain]
    assert np.abs(errors).max() < PERIOD / 10
    assert errors[1:] == pytest.approx(0.0, abs=1e-6)
    assert mapped(clock(TimeBase.STREAM), stamps, arrivals)[0].certain


def test_of_a_backlog_nothing_is_delivered() -> None:
    """Ten times as fast as it was filmed: only the last picture may be of its arrival, which no other confirms."""
    received, faults = read(sent_stream(), base=TimeBase.ARRIVAL, tick=PERIOD / 10)
    assert received.pictures == []
    assert faults["backlog"] == 59
    received, faults = read(sent_stream(), base=TimeBase.ARRIVAL, tick=PERIOD)
    assert received.numbers == [n % 12 for n in range(60)]
    assert "backlog" not in faults


def test_a_clock_that_runs_fast_is_followed_by_arrival() -> None:
    stamps = np.arange(0, 3600, 0.5)
    arrivals = UNIX + stamps / 1.0002  # 0.7 s an hour
    times = placed(clock(TimeBase.ARRIVAL), stamps, arrivals)
    assert np.abs(np.array(times) - arrivals).max() < 0.008


def test_stream_takes_stamps_and_offsets() -> None:
    assert placed(clock(TimeBase.STREAM, offset_seconds=-0.25), [5.0, 5.5], [UNIX, UNIX + 0.5]) == [4.75, 5.25]


@pytest.mark.parametrize("jump", [100.0, -100.0, 1e6, -1.5])
@pytest.mark.parametrize("base", TimeBase)
def test_after_a_jump_pictures_go_on_as_late_as_before(base: TimeBase, jump: float) -> None:
    mapper = clock(base)
    before, after = np.arange(90) * PERIOD, np.arange(90, 180) * PERIOD
    start = mapped(mapper, before, UNIX + before + 0.03)
    found = mapper.map(after[0] + jump, arrived=UNIX + after[0] + 0.034)
    assert found.fault is Fault.JUMP
    assert found.reset_seconds == pytest.approx(jump, abs=0.005)
    rest = mapped(mapper, after[1:] + jump, UNIX + after[1:] + 0.03)
    assert np.abs(steps([*start, found, *rest]) - PERIOD).max() < 0.005


def test_cameras_whose_common_clock_is_set_stay_in_step_exactly() -> None:
    """Their arrivals jitter by milliseconds, which would part them by as much."""
    resets = ClockResets()
    a, b = (ClockMapper(TimeBase.STREAM, resets=resets) for _ in range(2))
    for mapper in (a, b):
        placed(mapper, np.arange(30) * PERIOD, UNIX + np.arange(30) * PERIOD)
    first = a.map(500.0, arrived=UNIX + 1.0 + 0.012)
    second = b.map(500.0, arrived=UNIX + 1.0 + 0.003)
    assert first.seconds == second.seconds
    third = ClockMapper(TimeBase.STREAM, resets=resets)
    placed(third, [0.0, 0.5], [UNIX, UNIX + 0.5])
    other = third.map(900.0, arrived=UNIX + 1.0)
    assert other.seconds == pytest.approx(1.0)


@pytest.mark.parametrize("base", TimeBase)
@pytest.mark.parametrize("stamp", [0.0, 3.0, 5000.0])
def test_stamps_of_a_new_connection_may_begin_anew(base: TimeBase, stamp: float) -> None:
    mapper = clock(base)
    placed(mapper, np.arange(91) * PERIOD, UNIX + np.arange(91) * PERIOD)
    mapper.reconnect()
    times = np.arange(30) * PERIOD
    found = mapped(mapper, stamp + times, UNIX + 10 + times)
    assert {item.fault for item in found} == {None}
    if base is TimeBase.ARRIVAL or stamp != 3.0:
        assert np.allclose(steps(found), PERIOD, atol=1e-5)
    if base is TimeBase.ARRIVAL:
        assert found[0].seconds == pytest.approx(UNIX + 10, abs=1e-3)


def test_duplicates_and_stamps_that_go_back_are_left_out() -> None:
    found = mapped(clock(TimeBase.STREAM), [0.0, 0.1, 0.1, 0.3, 0.2, 0.4], UNIX + 0.1 * np.arange(6))
    assert [item.fault for item in found] == [None, None, Fault.DUPLICATE, None, Fault.REORDERED, None]
    assert [item.seconds for item in found] == [0.0, 0.1, None, 0.3, None, 0.4]


@pytest.mark.parametrize("base", TimeBase)
def test_stamps_of_33_bits_wrap(base: TimeBase) -> None:
    true = WRAP - 1 + np.arange(60) * PERIOD
    found = mapped(clock(base), true % WRAP, UNIX + true, wrap_seconds=WRAP)
    assert {item.fault for item in found} == {None}
    assert np.allclose(steps(found), PERIOD)


def test_unix_stamps_are_found_again_from_33_bits() -> None:
    mapper = clock(TimeBase.UNIX)
    true = UNIX + np.arange(10) * PERIOD
    times = placed(mapper, true % WRAP, true + 0.2, wrap_seconds=WRAP)
    assert times == pytest.approx(list(true), abs=1e-5)
    assert mapper.shift == pytest.approx(UNIX - UNIX % WRAP, abs=1e-5)


@given(
    st.sampled_from(list(TimeBase)),
    st.lists(st.tuples(st.floats(-200, 200), st.floats(0, 3)), min_size=1, max_size=60),
)
@examples(150)
def test_times_rise_whatever_comes(base: TimeBase, steps: list[tuple[float, float]]) -> None:
    mapper, stamp, arrived, last = clock(base), 0.0, UNIX, -np.inf
    for by, wait in steps:
        stamp, arrived = stamp + by, arrived + wait
        seconds = mapper.map(stamp, arrived=arrived, wrap_seconds=WRAP).seconds
        if seconds is not None:
            assert seconds > last
            last = seconds
