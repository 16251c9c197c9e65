# SPDX-License-Identifier: Apache-2.0
"""Records the cameras' packets, so that a live run can be repeated from files.

Each camera has a file: MPEG-TS for codecs that it supports, Matroska for others; both can be read up to where a crash
truncated them. Time stamps are those of the common clock, less its value at the start, so that a camera that
reconnected or whose clock was reset stays synchronised (later by a constant, which ``capture.json`` states, if they
would be negative); pictures are not encoded again. ``capture.json`` makes the
folder a prepared capture of the cameras that sent something. Damaged packets, those after them up to the next key
packet, and pictures of other proportions are not recorded.

A file has one codec, and time stamps of MPEG-TS wrap after 26 hours. After :data:`PART_SECONDS`, and when a camera
returns with another codec, size or parameters, every camera continues, at its next key frame, in the folder
``part-001``, then ``part-002``, each a capture, too.
"""

import json
import logging
import re
import threading
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from structgstream.atomic_files import atomic_write
from structgstream.data.live.status import FaultLog
from structgstream.data.masks import FOLDER, lasting_mask
from structgstream.data.prepared import PreparedCapture, write_prepared
from structgstream.data.timeline import Clock
from structgstream.data.video_index import load_av
from structgstream.errors import StorageError
from structgstream.frames import MultiViewFrame

if TYPE_CHECKING:
    from av.packet import Packet

log = logging.getLogger(__name__)

PART_SECONDS = 12 * 3600.0
LEAD_SECONDS = 10.0  # for cameras whose first pictures were taken before those of the first packet
UNKNOWN_REORDERING_SECONDS = 1.0
"""From decoding to presentation of packets that do not state it, as the first ones of RTSP and Matroska with B-frames:
less than it is would move pictures to later times."""
MPEGTS_CODECS = frozenset({"h264", "hevc", "mpeg2video"})
TICKS = 90_000
STAMPS, FRAMES = "timestamps.csv", "frames.jsonl"


class Recording:
    """The folder of a recording, which is made; if it is not empty, the recording goes to its next part. Of ``masks``,
    the folder of masks of the calibration, those for all frames are copied. Raises StorageError if it cannot be
    written, here or later."""

    def __init__(self, folder: Path, calibration: PreparedCapture, *, fps: float, masks: Path) -> None:
        self._folder, self._calibration, self._fps, self._masks = folder, calibration, fps, masks
        self._starts: list[float] = []  # of the parts, on the common clock
        self._lock = threading.RLock()
        self._folders: dict[int, Path] = {}
        self._files: dict[int, dict[str, tuple[str, Clock]]] = {}
        self._cameras: list[CameraRecorder] = []
        self._texts: dict[Path, IO[str]] = {}
        made = self.folder(0, {})
        if made != folder:
            log.warning("%s is not empty; the recording goes to %s", folder, made)

    def camera(self, name: str, faults: FaultLog) -> "CameraRecorder":
        """The recorder of a camera."""
        self._cameras.append(CameraRecorder(self, name, faults))
        return self._cameras[-1]

    def part_at(self, common_seconds: float) -> int:
        """The number of the part of an instant of the common clock."""
        with self._lock:
            if not self._starts:
                self._starts = [common_seconds - LEAD_SECONDS]
            while common_seconds - self._starts[-1] >= PART_SECONDS:
                self._starts.append(self._starts[-1] + PART_SECONDS)
            return max(bisect_right(self._starts, common_seconds) - 1, 0)

    def time_in_part(self, number: int, common_seconds: float) -> float:
        """Seconds from the start of a part to an instant of the common clock."""
        with self._lock:
            return common_seconds - self._starts[number]

    def next_part(self, part: int, common_seconds: float) -> int | None:
        """The part in which a new file may start at an instant, after one in ``part``; None if none may yet."""
        with self._lock:
            number = self.part_at(common_seconds)
            if number == part == len(self._starts) - 1:
                self._starts.append(common_seconds)
                number += 1
            return number if number > part else None

    def folder(self, number: int, files: Mapping[str, tuple[str, Clock]]) -> Path:
        """The folder of a part, whose ``capture.json`` then names these files of cameras, with their clocks, and those
        before."""
        with self._lock:
            if number not in self._folders:
                # Looked up only now: another recording in the folder may have begun further parts meanwhile.
                folder = _next_part(self._folder)
                try:
                    folder.mkdir(parents=True, exist_ok=True)
                except OSError as error:
                    raise StorageError(f"The folder {folder} cannot be made ({error.strerror}).") from None
                self._folders[number], self._files[number] = folder, {}
            folder, known = self._folders[number], self._files[number]
            known.update(files)
            cameras = {}
            for name, camera in self._calibration.cameras.items():
                file, clock = known.get(name, (f"{name}.ts", Clock()))
                cameras[name] = replace(camera, files=file, clock=clock)
            capture = replace(self._calibration, cameras=cameras, fps=self._fps, points=None)
            write_prepared(folder, capture.only(known) if known else capture)
            for name in files:
                self._copy_mask(name, folder / FOLDER)
            return folder

    def _copy_mask(self, name: str, folder: Path) -> None:
        try:
            mask = lasting_mask(self._masks, name)
            content = None if mask is None else mask.read_bytes()
        except OSError as error:
            raise StorageError(f"The masks in {self._masks} cannot be read ({error.strerror}).") from None
        if content is not None:
            atomic_write(folder / f"{name}.png", content, called="The mask", new_folder=True)

    def add_frame(self, frame: MultiViewFrame, *, common_seconds: float) -> None:
        """Records which instant became which frame of the stream."""
        number = self.part_at(common_seconds)
        entry = {
            "index": frame.index,
            "pts_seconds": round(frame.pts_seconds, 6),
            "recorded_seconds": round(self.time_in_part(number, common_seconds), 6),
            "captured_unix_seconds": frame.captured_unix_seconds,
            "cameras": [*frame.images],
        }
        self.add_line(number, FRAMES, json.dumps(entry) + "\n")

    def add_line(self, number: int, file: str, line: str) -> None:
        """Appends a line to a text file of a part."""
        path = (self._folders.get(number) or self.folder(number, {})) / file
        try:
            with self._lock:
                text = self._texts.get(path)
                if text is None:
                    text = self._texts[path] = path.open("a", buffering=1)
                    if file == STAMPS:
                        text.write("camera,recorded_seconds,common_seconds,key\n")
                text.write(line)
        except OSError as error:
            raise StorageError(f"{path} cannot be written ({error.strerror}).") from None

    def close(self) -> None:
        """Closes all files; what cannot be written any more is left out."""
        for camera in self._cameras:
            camera.close()
        for text in self._texts.values():
            with suppress(OSError):
                text.close()


class CameraRecorder:
    """Records the packets of one camera; called from its thread. A failure is logged and ends its recording."""

    def __init__(self, recording: Recording, name: str, faults: FaultLog) -> None:
        self._recording, self._name, self._faults = recording, name, faults
        self._output: Any = None
        self._stream: Any = None
        self._codec: tuple[object, ...] | None = None
        self._part = -1
        self._last = -1
        self._later = 0.0  # how much later than on the common clock its file has its pictures, seconds
        self._failed = False
        self._lock = threading.Lock()

    def record(self, packet: "Packet", *, shift_seconds: float) -> None:
        """Records a packet, whose time on the common clock is its stamp plus ``shift_seconds``."""
        if self._failed:
            return
        if packet.pts is None or packet.time_base is None:
            self._faults.warn(self._name, "recording", "sends packets without time stamps, which are not recorded")
            return
        with self._ending_on_error():
            self._record(packet, shift_seconds)

    def close(self) -> None:
        """Closes the file."""
        with self._ending_on_error():
            self._close()
        self._failed = True

    @contextmanager
    def _ending_on_error(self) -> Iterator[None]:
        try:
            with self._lock:
                yield
        except (load_av().error.FFmpegError, OSError, ValueError, StorageError) as error:
            self._failed = True
            reason = getattr(error, "strerror", None) or error
            self._faults.warn(self._name, "recording", f"is no longer recorded ({reason}); the stream goes on")

    def _record(self, packet: "Packet", shift_seconds: float) -> None:
        assert packet.pts is not None
        pts = float(packet.pts * packet.time_base)
        common = pts + shift_seconds
        number = self._recording.part_at(common)
        same = self._output is not None and _codec(packet.stream) == self._codec
        starts = packet.is_keyframe and (number > self._part or not same)
        if starts and (new := self._recording.next_part(self._part, common)) is not None:
            self._open(packet, new, common)
            number, same = new, True
        if not same or number < self._part:
            return
        stamp = self._recording.time_in_part(self._part, common) + self._later
        behind = UNKNOWN_REORDERING_SECONDS if packet.dts is None else pts - float(packet.dts * packet.time_base)
        self._write(packet, round(stamp * TICKS), round(behind * TICKS))
        line = f"{self._name},{stamp:.6f},{common:.6f},{int(packet.is_keyframe)}\n"
        self._recording.add_line(self._part, STAMPS, line)

    def _write(self, packet: "Packet", pts: int, behind: int) -> None:
        """Writes a copy of the packet with other time stamps; those of decoding must increase."""
        copy = load_av().Packet(bytes(packet))
        copy.stream = self._stream
        copy.time_base = Fraction(1, TICKS)
        copy.dts = max(pts - behind, self._last + 1)
        copy.pts = max(pts, copy.dts)
        copy.is_keyframe = packet.is_keyframe
        self._last = copy.dts
        self._output.mux(copy)

    def _open(self, packet: "Packet", number: int, common_seconds: float) -> None:
        self._close()
        begin = self._recording.time_in_part(number, common_seconds)
        # Its clock is far behind that of the first camera: a file has no times before 0.
        self._later = 0.0 if begin >= 0 else LEAD_SECONDS - begin
        codec = packet.stream.codec_context.name
        suffix, kind = ("ts", "mpegts") if codec in MPEGTS_CODECS else ("mkv", "matroska")
        name = f"{self._name}.{suffix}"
        folder = self._recording.folder(number, {self._name: (name, Clock(0.0 - self._later))})
        self._output = load_av().open(str(folder / name), "w", format=kind, options={"flush_packets": "1"})
        self._stream = self._output.add_stream_from_template(packet.stream)
        self._codec, self._part, self._last = _codec(packet.stream), number, -1

    def _close(self) -> None:
        if self._output is not None:
            output, self._output = self._output, None
            output.close()


def _codec(stream: Any) -> tuple[object, ...]:
    """Codec, size and parameters, of which a file has one."""
    context = stream.codec_context
    return context.name, context.width, context.height, bytes(context.extradata or b"")


def _next_part(folder: Path) -> Path:
    """The folder of the next part: nothing is in it, nor in those that follow."""
    try:
        entries = [entry.name for entry in folder.iterdir()] if folder.exists() else []
    except OSError as error:
        raise StorageError(f"The folder {folder} cannot be read ({error.strerror}).") from None
    if not entries:
        return folder
    parts = (re.fullmatch(r"part-(\d{3,})", name) for name in entries)
    return folder / f"part-{1 + max((int(part[1]) for part in parts if part), default=0):03d}"
