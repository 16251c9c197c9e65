# SPDX-License-Identifier: Apache-2.0
"""One camera of a live run: a thread that opens, decodes and opens again.

A picture that cannot be trusted is not delivered: after a damage none until the next key frame, none whose proportions
are not the calibration's, none of a picture that stands still while others change.
"""

import logging
import threading
import zlib
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, closing
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from structgstream.data.live.faults import Fault, FaultLog
from structgstream.data.live.matching import LivePicture
from structgstream.data.live.rig_file import LiveCamera, TimeBase
from structgstream.data.live.stamps import StampReader
from structgstream.data.video_index import load_av, video_stream
from structgstream.remote_folders import without_secrets

if TYPE_CHECKING:
    from av.packet import Packet
    from av.video.frame import VideoFrame

log = logging.getLogger(__name__)

FIRST_WAIT_SECONDS, MAX_WAIT_SECONDS = 0.5, 8.0
MPEGTS_STAMPS = 2**33
MAX_UNSTAMPED = 30  # pictures before a camera is taken to have no stamps
SAMPLED_ROWS = 4  # every so many rows are compared to find pictures that stand still
ENDED = "it ended"
PROBE_OPTIONS = {"analyzeduration": "2000000", "probesize": "2000000", "fpsprobesize": "0"}


class Receiver(Protocol):
    """Gets a camera's pictures, called from its thread."""

    def deliver(self, camera: str, picture: LivePicture) -> None:
        """A picture."""
        ...

    def lost(self, camera: str) -> None:
        """The camera has gone, or sends nothing that can be used."""
        ...

    def others_changed_at(self, camera: str) -> float:
        """When a picture of any other camera last differed from the one before, monotonic seconds."""
        ...


class PacketKeeper(Protocol):
    """Keeps a camera's packets as they came."""

    def keep(self, packet: "Packet", *, shift_seconds: float) -> None:
        """A packet whose picture lies at its stamp plus ``shift_seconds`` on the common clock."""
        ...


Opens = Callable[[LiveCamera, float], AbstractContextManager[Any]]


class CameraFeed:
    """Reads one camera until it is stopped, or until its file ends or cannot be read.

    Args:
        name: of the camera.
        camera: how it is read.
        size: width and height of the calibration's pictures.
        receiver: gets its pictures.
        stamps: places them.
        faults: is told what is wrong.
        base: what says when a picture was taken.
        now: monotonic seconds; ``unix_offset`` added, Unix time.
        unix_offset: see ``now``.
        silent_seconds: without packets for so long, it is opened again.
        stuck_seconds: the same picture for so long is not used if others change.
        keeper: keeps its packets, or None.
        opens: opens a camera with a timeout in seconds.
        wait: waits before the camera is opened again; None for seconds, or until :meth:`stop`.
    """

    def __init__(
        self,
        name: str,
        camera: LiveCamera,
        *,
        size: tuple[int, int],
        receiver: Receiver,
        stamps: StampReader,
        faults: FaultLog,
        base: TimeBase,
        now: Callable[[], float],
        unix_offset: float,
        silent_seconds: float,
        stuck_seconds: float,
        keeper: PacketKeeper | None = None,
        opens: Opens | None = None,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        self.name, self._camera, self._size = name, camera, size
        self._receiver, self._stamps, self._faults, self._base = receiver, stamps, faults, base
        self._now, self._unix_offset = now, unix_offset
        self._silent, self._stuck = silent_seconds, stuck_seconds
        self._keeper = keeper
        self._opens = open_camera if opens is None else opens
        self._stop = threading.Event()
        self._wait = self._stop.wait if wait is None else wait
        # A daemon, so that a camera that hangs in the system cannot keep the program from ending.
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)
        self._checksum: int | None = None
        self._damaged, self._shown = True, False
        self._before: Packet | None = None
        self._gone_since: float | None = None
        self._paced: float | None = None
        self._without_stamp = 0
        self._proper = True
        self.ended = False
        self.decoded = 0
        self.changed_at = -float("inf")

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
            reason = self._connection()
            if self._stop.is_set():
                return
            if self._camera.is_file:
                self._end(reason)
                return
            self._gone(reason)
            wait = FIRST_WAIT_SECONDS if self.decoded > before else min(2 * wait, MAX_WAIT_SECONDS)
            self._wait(wait)

    def _connection(self) -> str:
        """Reads until the camera ends or fails; why it did."""
        av = load_av()
        try:
            with self._opens(self._camera, self._silent) as container:
                self._read(container)
        except av.error.ExitError:
            return f"nothing came for {self._silent:g} s"
        except (av.error.FFmpegError, OSError, ValueError) as error:
            return str(getattr(error, "strerror", None) or error)
        except Exception as error:  # Whatever it is: a thread that ends would be a camera that never comes back.
            log.exception("camera %r cannot be read", self.name)
            said = without_secrets(str(error), self._camera.url, *self._camera.options.values())
            return f"{type(error).__name__}: {said}"
        return ENDED

    def _read(self, container: Any) -> None:
        if not container.streams.video:
            raise ValueError("there is no video in it")
        stream = video_stream(container)
        if stream.codec_context is None:
            raise ValueError("its coding is unknown to the installed PyAV")
        stream.codec_context.thread_count = 1  # the cameras are the parallelism
        self._stamps.reconnect()
        ticks = MPEGTS_STAMPS if container.format.name == "mpegts" else None
        self._damaged, self._shown = True, False  # until the first key frame, before which it is none that counts
        self._before = None
        for packet in container.demux(stream):
            if self._stop.is_set():
                return
            if self._repeats(packet):
                continue
            shift = None
            for frame in self._frames(packet):
                wrap = None if ticks is None or frame.time_base is None else float(ticks * frame.time_base)
                shift = self._picture(frame, wrap)
            usable = self._proper and not self._damaged and not packet.is_corrupt
            if self._keeper is not None and packet.size and usable:
                self._keeper.keep(packet, shift_seconds=self._stamps.shift if shift is None else shift)

    def _repeats(self, packet: "Packet") -> bool:
        """Whether the packet is the one before once more: decoded twice, its differences would be added twice."""
        before, self._before = self._before, packet
        if before is None or packet.pts is None or (packet.pts, packet.size) != (before.pts, before.size):
            return False
        if not packet.size or bytes(packet) != bytes(before):
            return False
        self._repeated()
        return True

    def _repeated(self) -> None:
        text = "sends two pictures with one time stamp; the first is taken"
        self._faults.tell(self.name, Fault.DUPLICATE, text)

    def _frames(self, packet: "Packet") -> "Iterable[VideoFrame]":
        """The pictures of a packet; none from a damage on until the next key frame."""
        if packet.is_corrupt:
            self._damage("a packet is missing or broken")
            return
        try:
            frames = packet.decode()
        except load_av().error.FFmpegError as error:
            self._damage(error.strerror)
            return
        for frame in frames:
            if frame.is_corrupt:
                self._damage("a frame is broken")
            elif not self._damaged or frame.key_frame:
                self._damaged, self._shown = False, True
                yield frame

    def _damage(self, reason: str) -> None:
        self._damaged = True
        if not self._shown:
            return
        self._receiver.lost(self.name)
        text = f"sends what cannot be decoded ({reason}); it is absent until its next key frame"
        self._faults.tell(self.name, Fault.GARBAGE, text)

    def _picture(self, frame: "VideoFrame", wrap_seconds: float | None) -> float:
        """Delivers a decoded frame unless something is wrong with it; the shift from its stamp to the common clock."""
        self._keep_pace(frame)
        arrived = self._now()
        self.decoded += 1
        self._back(arrived)
        seconds = self._placed(frame, arrived, wrap_seconds)
        self._proper = self._fits(frame)
        if seconds is not None and self._proper and not self._stands_still(frame, arrived):
            self._receiver.deliver(self.name, LivePicture(seconds, arrived, frame))
        return self._stamps.shift

    def _keep_pace(self, frame: "VideoFrame") -> None:
        """A file that is complete is read at the speed at which it was filmed."""
        if not self._camera.is_file or frame.time is None:
            return
        if self._paced is None:
            self._paced = self._now() - frame.time
        self._stop.wait(max(self._paced + frame.time - self._now(), 0.0))

    def _placed(self, frame: "VideoFrame", arrived: float, wrap_seconds: float | None) -> float | None:
        """When the picture was taken, on the common clock; None if it must not be used."""
        unix = arrived + self._unix_offset
        if frame.pts is None or frame.time_base is None:
            stamp, wrap_seconds = self._unstamped(unix), None
        else:
            stamp, self._without_stamp = float(frame.pts * frame.time_base), 0
        if stamp is None:
            return None
        placed = self._stamps.place(stamp, arrived=unix, wrap_seconds=wrap_seconds)
        if placed.fault is Fault.JUMP:
            text = f"has set its clock by {placed.jump_seconds:+.3f} s; its pictures go on in step with their arrival"
            self._faults.tell(self.name, Fault.JUMP, text)
        elif placed.fault is Fault.DUPLICATE:
            self._repeated()
        elif placed.fault is Fault.REORDERED:
            self._faults.tell(self.name, placed.fault, "sends pictures whose time stamps go back; they are left out")
        return placed.seconds

    def _unstamped(self, unix: float) -> float | None:
        """What stands for the stamp of a picture without one; None if it must not be used."""
        self._faults.count(self.name, Fault.NO_STAMP)
        self._without_stamp += 1
        if self._base is not TimeBase.ARRIVAL:
            text = 'sends pictures without time stamps; take clock = "arrival" for this rig if all are'
            self._faults.say(self.name, Fault.NO_STAMP.value, text)
            return None
        # The first ones of a connection may have none, and others that follow do.
        return unix if self._without_stamp > MAX_UNSTAMPED else None

    def _fits(self, frame: "VideoFrame") -> bool:
        """Whether the picture has the proportions that were calibrated; a uniform reduction has."""
        width, height = self._size
        if (frame.width, frame.height) == (width, height):
            return True
        alike = abs(frame.width * height - width * frame.height) <= max(width, height)
        what = "it is resampled" if alike else "it is absent until that is mended, because what is cut off is unknown"
        text = f"sends {frame.width}x{frame.height} pixels, its calibration is for {width}x{height}; {what}"
        self._faults.tell(self.name, Fault.OTHER_SIZE, text)
        if not alike:
            self._receiver.lost(self.name)
        return alike

    def _stands_still(self, frame: "VideoFrame", arrived: float) -> bool:
        """Whether the picture has been the same for long while those of other cameras changed."""
        checksum = picture_checksum(frame)
        if checksum != self._checksum:
            self._checksum, self.changed_at = checksum, arrived
            return False
        if self._receiver.others_changed_at(self.name) - self.changed_at < self._stuck:
            return False
        text = f"has sent the same picture for {arrived - self.changed_at:.1f} s; it is absent until that changes"
        self._faults.tell(self.name, Fault.STUCK, text)
        self._receiver.lost(self.name)
        return True

    def _end(self, reason: str) -> None:
        """Nothing more comes of a file: it was read, or cannot be."""
        self._receiver.lost(self.name)
        if self.decoded:
            how = "" if reason is ENDED else f" ({reason})"
            text = f"has come to the end of its file {self._camera.shown_url}{how}; it is absent from now on"
        else:
            text = (
                f"is absent, because its file {self._camera.shown_url} cannot be read ({reason}); correct its url in "
                "the rig file, or give follow = true if the file is still to be written"
            )
        self._faults.tell(self.name, Fault.GONE, text)
        self.ended = True

    def _gone(self, reason: str) -> None:
        if self._gone_since is None:
            self._gone_since = self._now()
        self._receiver.lost(self.name)
        text = f"at {self._camera.shown_url} is gone ({reason}); it is absent, and is opened again until it is back"
        self._faults.tell(self.name, Fault.GONE, text)

    def _back(self, arrived: float) -> None:
        if self._gone_since is not None:
            self._faults.say(self.name, "back", f"is back after {arrived - self._gone_since:.1f} s")
            self._gone_since = None


def open_camera(camera: LiveCamera, timeout_seconds: float) -> AbstractContextManager[Any]:
    """The opened camera.

    Raises:
        OSError: it cannot be opened; FFmpeg's errors are OSErrors or ValueErrors.
    """
    options = {**PROBE_OPTIONS, **camera.options}
    if camera.follow:
        options["follow"] = "1"
    if camera.is_session:
        # Without this FFmpeg opens nothing but files from a file.
        options.setdefault("protocol_whitelist", "file,udp,rtp")
    # A timeout is refused by FFmpeg where it listens for a sender, which has listen_timeout instead.
    timeout = None if options.get("rtsp_flags") == "listen" else timeout_seconds
    return closing(load_av().open(camera.url, format=camera.format, options=options, timeout=timeout))


def picture_checksum(frame: "VideoFrame") -> int:
    """A number that pictures which are the same have in common: of some rows of the first plane."""
    plane = frame.planes[0]
    bytes_of = np.asarray(memoryview(cast(bytes, plane)), np.uint8)
    rows = bytes_of.reshape(-1, plane.line_size)[: plane.height : SAMPLED_ROWS, : plane.width]
    return zlib.crc32(rows.tobytes())
