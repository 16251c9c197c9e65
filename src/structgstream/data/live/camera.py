# SPDX-License-Identifier: Apache-2.0
"""One camera of a live run: a thread that opens it, decodes its pictures and reconnects, and its clock.

Pictures are withheld after a decoding error until the next key frame, if their proportions are not those of the
calibration, and if they are frozen while those of other cameras change. Their times on the common clock come from time
stamps that may jump, repeat, go back or wrap.

Note [Minimum delay]
~~~~~~~~~~~~~~~~~~~~
Encoder and network delay each picture by another amount. The minimum of arrival minus stamp over some seconds is steady
to milliseconds, so with ``arrival`` a picture's time is its stamp plus that minimum. Times never decrease: a new
minimum puts a picture at its arrival, and arrivals increase. Old differences expire, so clocks that run fast or slow
are tracked.

A clock was reset if a stamp goes back by more than :data:`RESET_SECONDS`, or is that much earlier than the minimum
delay allows. Pictures that a network delayed come late, never early, so they do not look like a reset.

Note [Backlog]
~~~~~~~~~~~~~~
A connection often begins with a backlog: what a server has cached since its last key frame, or what came while FFmpeg
probed the stream. Its pictures arrive faster than they were taken, so the minimum delay falls with each of them, and
the time of a picture is too late by all that is left of the backlog. So with ``arrival`` the first picture of a
connection is delivered only with the next one, and not at all if that lowers the minimum by more than
:data:`BACKLOG_SHARE` of the step between their stamps; then the next one waits in turn.
"""

import logging
import threading
import zlib
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from structgstream.data.live.recorder import CameraRecorder
from structgstream.data.live.rig_file import LiveCamera, LiveRig, TimeBase
from structgstream.data.live.status import Fault, FaultLog
from structgstream.data.live.synchronizer import FrameSynchronizer, LivePicture
from structgstream.data.sound import LiveSound
from structgstream.data.video_index import TURNS, display_matrix, load_av, video_stream
from structgstream.remote_folders import without_secrets

if TYPE_CHECKING:
    from av.audio.frame import AudioFrame
    from av.packet import Packet
    from av.video.frame import VideoFrame

log = logging.getLogger(__name__)

RESET_SECONDS = 1.0
WINDOW_SECONDS = 15.0
DUPLICATE_SECONDS = 1e-6
BACKLOG_SHARE = 0.1
SAME_RESET_SECONDS = 0.1
FIRST_WAIT_SECONDS, MAX_WAIT_SECONDS = 0.5, 8.0
MPEGTS_WRAP_SECONDS = 2**33 / 90_000
MPEGTS_FORMATS = ("mpegts", "rtp")  # the latter: MPEG-TS in RTP, the only RTP that an address alone describes
MAX_UNSTAMPED = 30  # pictures before a camera is taken to have no stamps
MAX_SOUND_APART_SECONDS = 10.0
"""Of the stamps of sound and pictures that come together; when a camera sets its clock, sound may come first."""
FAR_SECONDS = 60.0  # of Unix time by stamps from that of this machine, before it is reported
MAX_HELD = 64  # packets; decoders of H.264 and HEVC hold back 16 pictures, of up to two packets each
SAMPLED_ROWS = 4  # every so many rows are compared to find pictures that stand still
ENDED = "it ended"
ARRIVAL_TICK = Fraction(1, 1_000_000)
NO_TIMESTAMPS = 0x80
"""FFmpeg's flag of formats without time stamps (AVFMT_NOTIMESTAMPS)."""
PROBE_OPTIONS = {"analyzeduration": "2000000", "probesize": "2000000", "fpsprobesize": "0"}


@dataclass(frozen=True)
class PictureTime:
    """When a picture was taken."""

    seconds: float | None  # on the common clock; None if the picture must not be used
    fault: Fault | None = None  # what was wrong with its time stamp, or None
    reset_seconds: float = 0.0  # by how much the camera's clock was reset, with :attr:`Fault.JUMP`
    certain: bool = True  # False: only the next picture shows whether it waited in a backlog (Note [Backlog])


class ClockResets:
    """Corrections for clock resets, shared by the cameras: those of one common clock get one correction, and so stay
    synchronised exactly. Thread-safe."""

    def __init__(self) -> None:
        self._known: list[float] = []
        self._lock = threading.Lock()

    def common(self, correction: float) -> float:
        """The correction of another camera if it is within 0.1 s of this one, else this one."""
        with self._lock:
            for known in self._known:
                if abs(known - correction) < SAME_RESET_SECONDS:
                    return known
            self._known = [*self._known[-15:], correction]
            return correction


class MinimumDelayFilter:
    """Minimum of delays over the last :data:`WINDOW_SECONDS` to twice that (Note [Minimum delay])."""

    def __init__(self) -> None:
        self._window_start = -float("inf")
        self._previous = self._current = float("inf")

    @property
    def value(self) -> float:
        """The minimum, seconds; infinite without any delay."""
        return min(self._previous, self._current)

    def add(self, delay: float, at: float) -> None:
        """Adds a delay, measured at the time ``at``."""
        if at - self._window_start > WINDOW_SECONDS:
            self._window_start, self._previous, self._current = at, self._current, float("inf")
        self._current = min(self._current, delay)

    def restart(self, delay: float, at: float) -> None:
        """Starts again from one delay."""
        self._window_start, self._previous, self._current = at, float("inf"), delay


class ClockMapper:
    """Maps the time stamps of one camera to the common clock, in the order of presentation, across all its connections.

    ``offset_seconds`` is added to every time.
    """

    def __init__(self, base: TimeBase, *, resets: ClockResets, offset_seconds: float = 0.0) -> None:
        self.base, self._resets, self._offset = base, resets, offset_seconds
        self._delay = MinimumDelayFilter()
        self._stamp: float | None = None
        self._seconds = -float("inf")
        self._shift = self._wrapped = 0.0
        self._reconnected = False

    @property
    def shift(self) -> float:
        """What is added to a stamp as it comes, to get the time on the common clock; seconds."""
        return self._wrapped + self._shift + self._offset

    def reconnect(self) -> None:
        """The next picture is the first of a new connection, whose stamps may start again without a fault."""
        self._reconnected = True

    def map(self, stamp: float, *, arrived: float, wrap_seconds: float | None = None) -> PictureTime:
        """The time of the next picture, of which ``stamp`` is in seconds and ``arrived`` Unix time by a monotonic
        clock; stamps wrap around after ``wrap_seconds``, None for never."""
        if self._stamp is None:
            return self._first(stamp, arrived, wrap_seconds)
        if wrap_seconds is not None:  # the number of wraps that brings it nearest: FFmpeg may have added one of its own
            self._wrapped = round((self._stamp - stamp) / wrap_seconds) * wrap_seconds
        stamp += self._wrapped
        step, delay, reconnected = stamp - self._stamp, arrived - stamp, self._reconnected
        self._reconnected = False
        if reconnected and (step <= 0 or delay < self._delay.value - RESET_SECONDS):
            return self._begun(self._after_reset(stamp, delay, arrived).seconds)
        if abs(step) < DUPLICATE_SECONDS:
            return PictureTime(None, Fault.DUPLICATE)
        if step <= -RESET_SECONDS or delay < self._delay.value - RESET_SECONDS:
            return self._after_reset(stamp, delay, arrived)
        if step < 0:
            return PictureTime(None, Fault.REORDERED)
        earlier = self._delay.value - delay
        self._delay.add(delay, arrived)
        time = self._mapped(stamp)
        if self.base is TimeBase.ARRIVAL and earlier > BACKLOG_SHARE * step:
            return PictureTime(time.seconds, Fault.BACKLOG, certain=False)
        return time

    def _first(self, stamp: float, arrived: float, wrap_seconds: float | None) -> PictureTime:
        if self.base is TimeBase.UNIX and wrap_seconds is not None:
            self._shift = round((arrived - stamp) / wrap_seconds) * wrap_seconds
        self._delay.restart(arrived - stamp, arrived)
        return self._begun(self._mapped(stamp).seconds)

    def _begun(self, seconds: float | None) -> PictureTime:
        """Of the first picture of a connection."""
        return PictureTime(seconds, certain=self.base is not TimeBase.ARRIVAL)

    def _after_reset(self, stamp: float, delay: float, arrived: float) -> PictureTime:
        """The pictures continue with the delay that they had before the reset."""
        correction = delay - self._delay.value
        if self.base is not TimeBase.ARRIVAL:
            common = self._resets.common(correction)
            self._shift += common
            # The minimum delay of this camera is the one before, by the clock as it is now.
            delay = self._delay.value + common
        self._delay.restart(delay, arrived)
        return PictureTime(self._mapped(stamp).seconds, Fault.JUMP, -correction)

    def _mapped(self, stamp: float) -> PictureTime:
        self._stamp = stamp
        if self.base is TimeBase.ARRIVAL:
            self._shift = self._delay.value
        seconds = stamp + self._shift + self._offset
        if seconds <= self._seconds:
            return PictureTime(None, Fault.REORDERED)
        self._seconds = seconds
        return PictureTime(seconds)


def open_with_pyav(camera: LiveCamera, timeout_seconds: float) -> AbstractContextManager[Any]:
    """The opened camera."""
    # Without a list FFmpeg opens nothing but files from a file.
    session = {"protocol_whitelist": "file,udp,rtp"} if camera.is_session else {}
    options = {**PROBE_OPTIONS, **session, **camera.options}
    if camera.follow:
        options["follow"] = "1"
    # A timeout is refused by FFmpeg where it listens for a sender, which has listen_timeout instead.
    timeout = None if options.get("rtsp_flags") == "listen" else timeout_seconds
    return load_av().open(camera.url, format=camera.format, options=options, timeout=timeout)


class CameraFeed:
    """Reads one camera until it is stopped, or until its file ends or cannot be read.

    Args:
        size: width and height of the calibration's pictures.
        changed_at: by camera, when its picture last changed, monotonic seconds; shared by all feeds.
        now: monotonic seconds; ``unix_offset`` added, Unix time.
        resets: shared by all feeds.
        open_camera: opens a camera with a timeout in seconds.
        wait: waits some seconds before reconnecting; None for a wait that :meth:`stop` ends.
        sound: receives the camera's sound; None where that is not wanted.
    """

    def __init__(
        self,
        name: str,
        rig: LiveRig,
        *,
        size: tuple[int, int],
        synchronizer: FrameSynchronizer,
        changed_at: dict[str, float],
        resets: ClockResets,
        faults: FaultLog,
        now: Callable[[], float],
        unix_offset: float,
        recorder: CameraRecorder | None = None,
        open_camera: Callable[[LiveCamera, float], AbstractContextManager[Any]] = open_with_pyav,
        wait: Callable[[float], object] | None = None,
        sound: LiveSound | None = None,
    ) -> None:
        self.name, self._rig, self._camera, self._size = name, rig, rig.cameras[name], size
        self._clock = ClockMapper(rig.clock, resets=resets, offset_seconds=self._camera.offset_seconds)
        self._synchronizer, self._changed_at, self._faults = synchronizer, changed_at, faults
        self._now, self._unix_offset = now, unix_offset
        self._recorder, self._sound, self._open_camera = recorder, sound, open_camera
        self._stop = threading.Event()
        self._wait = self._stop.wait if wait is None else wait
        # A daemon, so that a camera that hangs in the system cannot keep the program from ending.
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)
        self._checksum: int | None = None
        self._damaged, self._decodes = True, False
        self._before: Packet | None = None
        self._held: list[Packet] = []  # to be recorded when their pictures come, which B-frames delay
        self._whole = False  # whether everything from a key packet on was held
        self._gone_since: float | None = None
        self._paced: float | None = None
        self._unstamped = 0
        self._wrap_seconds: float | None = None  # after which stamps of the container begin again
        self._stamp: float | None = None  # of the last picture, as it came
        self._uncertain: LivePicture | None = None  # which waits for the next one (Note [Backlog])
        self._usable = True
        self.ended = False
        self.decoded = 0

    def start(self) -> None:
        """Begins to read."""
        self._thread.start()

    def stop(self) -> None:
        """Ends reading; the thread ends within the time of one packet or of a timeout."""
        self._stop.set()

    def join(self, seconds: float) -> None:
        """Waits for the thread."""
        self._thread.join(seconds)

    def _run(self) -> None:
        wait = FIRST_WAIT_SECONDS
        while not self._stop.is_set():
            before = self.decoded
            reason = self._read_connection()
            if self._stop.is_set():
                return
            if self._camera.is_file:
                self._report_end(reason)
                return
            self._report_gone(reason)
            wait = FIRST_WAIT_SECONDS if self.decoded > before else min(2 * wait, MAX_WAIT_SECONDS)
            self._wait(wait)

    def _read_connection(self) -> str:
        """Reads until the connection ends; why it did."""
        av = load_av()
        try:
            with self._open_camera(self._camera, self._rig.silent_seconds) as container:
                self._read(container)
        except av.error.ExitError:
            return f"nothing came for {self._rig.silent_seconds:g} s"
        except (av.error.FFmpegError, OSError, ValueError) as error:
            return str(getattr(error, "strerror", None) or error)
        except Exception as error:  # Whatever it is: a thread that ends would be a camera that never comes back.
            log.exception("camera %r cannot be read", self.name)
            message = without_secrets(str(error), self._camera.url, *self._camera.options.values())
            return f"{type(error).__name__}: {message}"
        return ENDED

    def _read(self, container: Any) -> None:
        if not container.streams.video:
            raise ValueError("there is no video in it")
        stream = video_stream(container)
        if stream.codec_context is None:
            raise ValueError("its coding is unknown to the installed PyAV")
        stream.codec_context.thread_count = 1  # the cameras are the parallelism
        self._clock.reconnect()
        self._wrap_seconds = MPEGTS_WRAP_SECONDS if container.format.name in MPEGTS_FORMATS else None
        stamped = self._camera.is_file or not container.format.flags & NO_TIMESTAMPS
        self._damaged, self._decodes = True, False  # until the first key frame, before which damage is no fault
        self._before, self._held, self._whole = None, [], False
        for packet in container.demux(stream, *self._sound_streams(container)):
            if self._stop.is_set():
                return
            if packet.stream.type == "audio":
                self._hear(packet)
                continue
            if self._is_duplicate(packet):
                continue
            if not stamped:
                self._stamp_arrival(packet)
            self._hold(packet)
            for frame in self._frames(packet):
                self._record(frame, shift_seconds=self._picture(frame))

    def _stamp_arrival(self, packet: "Packet") -> None:
        """Stamps a packet of a format without stamps by its arrival: FFmpeg counts pictures at 25 a second, or leaves
        stamps out. Other clocks than ``arrival`` get none; neither do pictures that are not sent in their order."""
        packet.pts = packet.dts = None
        if self._clock.base is TimeBase.ARRIVAL and not packet.stream.codec_context.has_b_frames:
            packet.time_base = ARRIVAL_TICK
            packet.pts = packet.dts = round((self._now() + self._unix_offset) / ARRIVAL_TICK)

    def _hold(self, packet: "Packet") -> None:
        """Holds a packet that may be recorded, after damage from the next key packet on."""
        self._whole |= packet.is_keyframe
        if self._recorder is None or not packet.size or not self._whole:
            return
        self._held.append(packet)
        if len(self._held) > MAX_HELD:
            self._forget()

    def _forget(self, picture: int | None = None) -> None:
        """Drops what is held, after damage; ``picture`` is the stamp of a broken picture, and what is held from a key
        packet after it on remains."""
        stamps = [one.pts if one.is_keyframe else None for one in self._held]
        after = (n for n, pts in enumerate(stamps) if picture is not None and pts is not None and pts > picture)
        self._held = self._held[next(after, len(stamps)) :]
        self._whole = bool(self._held)

    def _record(self, frame: "VideoFrame", *, shift_seconds: float) -> None:
        """Records the packets of all pictures up to this one: only now it is known what is in them, and when."""
        while self._held and _is_of(self._held[0], frame):
            packet = self._held.pop(0)
            if self._recorder is not None and self._usable:
                self._recorder.record(packet, shift_seconds=shift_seconds)

    def _sound_streams(self, container: Any) -> list[Any]:
        """The stream of sound to read; none where sound is not wanted, or not sent."""
        if self._sound is None:
            return []
        if not container.streams.audio:
            self._faults.warn(self.name, "sound", "sends no sound, which --sound asks for; the stream is silent")
        return list(container.streams.audio[:1])

    def _hear(self, packet: "Packet") -> None:
        """Passes sound on; what cannot be decoded, comes before the first picture, or is far from it, is left out."""
        assert self._sound is not None
        try:
            for frame in cast("list[AudioFrame]", packet.decode()):
                if frame.time is None or self._stamp is None or not self._decodes:
                    continue
                if abs(frame.time - self._stamp) < MAX_SOUND_APART_SECONDS:
                    self._sound.add(frame, frame.time + self._clock.shift)
        except (load_av().error.FFmpegError, ValueError) as error:  # The pictures go on.
            self._faults.warn(self.name, "sound", f"sends sound that cannot be decoded ({error}); it is left out")

    def _is_duplicate(self, packet: "Packet") -> bool:
        """Whether the packet repeats the last one: decoded twice, its differences would be added twice."""
        before, self._before = self._before, packet
        if before is None or packet.pts is None or (packet.pts, packet.size) != (before.pts, before.size):
            return False
        if not packet.size or bytes(packet) != bytes(before):
            return False
        self._report_duplicate()
        return True

    def _report_duplicate(self) -> None:
        text = "sends two pictures with one time stamp; the first is taken"
        self._faults.report(self.name, Fault.DUPLICATE, text)

    def _frames(self, packet: "Packet") -> "Iterable[VideoFrame]":
        """The pictures of a packet; none after a decoding error until the next key frame."""
        if packet.is_corrupt:
            self._report_damage("a packet is missing or broken")
            return
        try:
            frames = packet.decode()
        except load_av().error.FFmpegError as error:
            self._report_damage(error.strerror)
            return
        for frame in frames:
            if frame.is_corrupt:
                self._report_damage("a frame is broken", picture=frame.pts)
            elif not self._damaged or frame.key_frame:
                if self._damaged:  # Pictures before a key frame that come after it refer to what is damaged.
                    self._held = [one for one in self._held if one.is_keyframe or not _is_of(one, frame)]
                self._damaged, self._decodes = False, True
                yield frame

    def _report_damage(self, reason: str, *, picture: int | None = None) -> None:
        self._damaged = True
        self._forget(picture)
        if self._decodes:
            text = f"sends what cannot be decoded ({reason}); it is absent until its next key frame"
            self._report_absent(Fault.GARBAGE, text)

    def _report_absent(self, fault: Fault, text: str) -> None:
        """Reports a fault that makes the camera absent."""
        self._synchronizer.mark_absent(self.name)
        self._faults.report(self.name, fault, text)

    def _picture(self, frame: "VideoFrame") -> float:
        """Delivers a decoded frame unless something is wrong with it; the shift from its stamp to the common clock."""
        self._pace(frame)
        arrived = self._now()
        self.decoded += 1
        self._report_back(arrived)
        time = self._common_time(frame, arrived)
        self._usable = self._has_calibrated_shape(frame)
        if time.seconds is not None and self._usable and not self._is_frozen(frame, arrived):
            self._deliver(LivePicture(time.seconds, arrived, frame), time)
        return self._clock.shift

    def _deliver(self, picture: LivePicture, time: PictureTime) -> None:
        """Passes a picture on, or keeps it until the next one shows that it did not wait (Note [Backlog])."""
        if time.fault is not Fault.BACKLOG:
            self._deliver_uncertain()
        self._uncertain = None if time.certain else picture
        if time.certain:
            self._synchronizer.add(self.name, picture)

    def _deliver_uncertain(self) -> None:
        if self._uncertain is not None:
            self._synchronizer.add(self.name, self._uncertain)
            self._uncertain = None

    def _pace(self, frame: "VideoFrame") -> None:
        """Reads a complete file at its frame rate."""
        if not self._camera.is_file or frame.time is None:
            return
        if self._paced is None:
            self._paced = self._now() - frame.time
        self._stop.wait(max(self._paced + frame.time - self._now(), 0.0))

    def _common_time(self, frame: "VideoFrame", arrived: float) -> PictureTime:
        """When the picture was taken, on the common clock."""
        unix = arrived + self._unix_offset
        if frame.pts is None or frame.time_base is None:
            stamp, wrap_seconds = self._substitute_stamp(unix), None
        else:
            stamp, wrap_seconds = float(frame.pts * frame.time_base), self._wrap_seconds
            self._unstamped = 0
        if stamp is None:
            return PictureTime(None)
        self._stamp = stamp
        time = self._clock.map(stamp, arrived=unix, wrap_seconds=wrap_seconds)
        if time.fault is Fault.JUMP:
            text = f"has set its clock by {time.reset_seconds:+.3f} s; its pictures go on in step with their arrival"
            self._faults.report(self.name, Fault.JUMP, text)
        elif time.fault is Fault.DUPLICATE:
            self._report_duplicate()
        elif time.fault is Fault.REORDERED:
            self._faults.report(self.name, time.fault, "sends pictures whose time stamps go back; they are left out")
        elif time.fault is Fault.BACKLOG:
            self._faults.count(self.name, time.fault)
        elif self._clock.base is TimeBase.UNIX and abs(far := (time.seconds or unix) - unix) > FAR_SECONDS:
            text = (
                f"sends time stamps {abs(far):.0f} s from the Unix time of this machine; set the clocks, or take "
                'clock = "arrival" in the rig file if its stamps are no Unix time'
            )
            self._faults.warn(self.name, "unix", text)
        return time

    def _substitute_stamp(self, unix: float) -> float | None:
        """The stamp to use for a picture without one; None if the picture must not be used."""
        self._faults.count(self.name, Fault.NO_STAMP)
        self._unstamped += 1
        if self._clock.base is not TimeBase.ARRIVAL:
            text = 'sends pictures without time stamps; take clock = "arrival" for this rig if all are'
            self._faults.warn(self.name, Fault.NO_STAMP.value, text)
            return None
        # The first ones of a connection may have none, and others that follow do.
        return unix if self._unstamped > MAX_UNSTAMPED else None

    def _has_calibrated_shape(self, frame: "VideoFrame") -> bool:
        """Whether the picture has the proportions of the calibration, at any size, and is stored as it is shown."""
        width, height = self._size
        until = "it is absent until that is mended"
        sizes = f"sends {frame.width}x{frame.height} pixels, its calibration is for {width}x{height}"
        if frame.interlaced_frame:
            text = f"sends interlaced pictures, whose lines are of two instants; {until}"
        elif TURNS.get(display_matrix(frame)) != 0:
            text = f"sends pictures that are turned or mirrored to be shown; {until}"
        elif abs(frame.width * height - width * frame.height) > max(width, height):
            text = f"{sizes}; {until}, because what is cut off is unknown"
        else:
            if (frame.width, frame.height) != (width, height):
                self._faults.report(self.name, Fault.OTHER_SIZE, f"{sizes}; it is resampled")
            return True
        self._report_absent(Fault.OTHER_SIZE, text)
        return False

    def _is_frozen(self, frame: "VideoFrame", arrived: float) -> bool:
        """Whether the picture has not changed for a long time while those of other cameras did."""
        checksum = picture_checksum(frame)
        if checksum != self._checksum:
            self._checksum, self._changed_at[self.name] = checksum, arrived
            return False
        changed_at = self._changed_at[self.name]
        others = (seconds for name, seconds in self._changed_at.items() if name != self.name)
        if max(others, default=changed_at) - changed_at < self._rig.stuck_seconds:
            return False
        text = f"has sent the same picture for {arrived - changed_at:.1f} s; it is absent until that changes"
        self._report_absent(Fault.STUCK, text)
        return True

    def _report_end(self, reason: str) -> None:
        """A file was read to its end, or cannot be read."""
        self._deliver_uncertain()
        if self.decoded:
            how = "" if reason is ENDED else f" ({reason})"
            text = f"has come to the end of its file {self._camera.shown_url}{how}; it is absent from now on"
        else:
            text = (
                f"is absent, because its file {self._camera.shown_url} cannot be read ({reason}); correct its url in "
                "the rig file, or give follow = true if the file is still to be written"
            )
        self._report_absent(Fault.GONE, text)
        self.ended = True

    def _report_gone(self, reason: str) -> None:
        if self._gone_since is None:
            self._gone_since = self._now()
        text = f"at {self._camera.shown_url} is gone ({reason}); it is absent, and is opened again until it is back"
        self._report_absent(Fault.GONE, text)

    def _report_back(self, arrived: float) -> None:
        if self._gone_since is not None:
            self._faults.warn(self.name, "back", f"is back after {arrived - self._gone_since:.1f} s")
            self._gone_since = None


def _is_of(packet: "Packet", picture: "VideoFrame") -> bool:
    """Whether a packet is of a picture or one before it, by their stamps."""
    return packet.pts is None or (picture.pts is not None and packet.pts <= picture.pts)


def picture_checksum(frame: "VideoFrame") -> int:
    """Checksum of some rows of a picture's first plane."""
    plane = frame.planes[0]
    values = np.asarray(memoryview(cast(bytes, plane)), np.uint8)
    rows = values.reshape(-1, plane.line_size)[: plane.height : SAMPLED_ROWS, : plane.width]
    return zlib.crc32(rows.tobytes())
