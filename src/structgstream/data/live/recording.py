# SPDX-License-Identifier: Apache-2.0
"""Keeps the cameras' own packets, so that a live run can be repeated from files.

Each camera has a file: MPEG-TS for codecs that it holds, Matroska for others; both can be read up to where a crash cut
them. Stamps are those of the common clock, less its value at the beginning, so that a camera that was opened again or
whose clock jumped stays in step; pictures are not coded again. ``capture.json`` beside them makes the folder a prepared
capture of the cameras that sent something. Damaged packets, and pictures of another size, are not kept.

A file holds one coding, and MPEG-TS counts 26 hours. After :data:`PART_SECONDS`, and when a camera comes back with
another codec, size or parameters, every camera goes on, at its next key frame, in the folder ``part-001``, then
``part-002``, each a capture too.
"""

import json
import logging
import threading
from bisect import bisect_right
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from structgstream.data.live.calibration import chosen_cameras
from structgstream.data.live.faults import FaultLog
from structgstream.data.prepared import FILE, PreparedCapture, write_prepared
from structgstream.data.timeline import Clock
from structgstream.data.video_index import load_av
from structgstream.errors import StorageError
from structgstream.frames import MultiViewFrame

if TYPE_CHECKING:
    from av.packet import Packet

log = logging.getLogger(__name__)

PART_SECONDS = 12 * 3600.0
LEAD_SECONDS = 10.0  # at the beginning, for cameras whose first pictures lie before the first packet that came
TRANSPORTED = frozenset({"h264", "hevc", "mpeg2video"})
TICKS = 90_000
STAMPS, FRAMES = "timestamps.csv", "frames.jsonl"


class Recording:
    """The folder of a recording.

    Args:
        folder: is made; where it holds a recording, this one goes on in its next part.
        calibration: of the cameras.
        fps: of the common timeline.
        unit_name: of the stream, for messages.

    Raises:
        StorageError: the folder cannot be written.
    """

    def __init__(self, folder: Path, calibration: PreparedCapture, *, fps: float, unit_name: str) -> None:
        self._folder, self._calibration, self._fps, self.name = folder, calibration, fps, unit_name
        self._begins: list[float] = []  # of the parts, on the common clock
        self._lock = threading.Lock()
        self._first = 0
        while (_part(folder, self._first) / FILE).exists():
            self._first += 1
        self._files: dict[int, dict[str, str]] = {}
        self._cameras: list[CameraRecorder] = []
        self._texts: dict[Path, IO[str]] = {}
        self.part(0, {})

    def camera(self, name: str, faults: FaultLog) -> "CameraRecorder":
        """The recorder of a camera."""
        self._cameras.append(CameraRecorder(self, name, faults))
        return self._cameras[-1]

    def number(self, common_seconds: float) -> int:
        """The part in which an instant of the common clock lies."""
        with self._lock:
            return self._number(common_seconds)

    def stamp(self, number: int, common_seconds: float) -> float:
        """Seconds from the beginning of a part to an instant of the common clock; negative before it."""
        with self._lock:
            return common_seconds - self._begins[number]

    def number_after(self, part: int, common_seconds: float) -> int | None:
        """The part in which a file may begin with an instant, after one in ``part``; None if a later one may."""
        with self._lock:
            number = self._number(common_seconds)
            if number == part == len(self._begins) - 1:
                self._begins.append(common_seconds)
                return number + 1
            return number if number > part and common_seconds >= self._begins[number] else None

    def _number(self, common_seconds: float) -> int:
        if not self._begins:
            self._begins = [common_seconds - LEAD_SECONDS]
        while common_seconds - self._begins[-1] >= PART_SECONDS:
            self._begins.append(self._begins[-1] + PART_SECONDS)
        return max(bisect_right(self._begins, common_seconds) - 1, 0)

    def part(self, number: int, files: Mapping[str, str]) -> Path:
        """The folder of a part, whose ``capture.json`` names the files of cameras that sent something."""
        with self._lock:
            folder = _part(self._folder, self._first + number)
            if number not in self._files:
                self._files[number] = {}
                try:
                    folder.mkdir(parents=True, exist_ok=True)
                except OSError as error:
                    raise StorageError(f"The folder {folder} cannot be made ({error.strerror}).") from None
            known = self._files[number]
            known.update(files)
            cameras = {
                name: replace(camera, files=known.get(name, f"{name}.ts"), clock=Clock())
                for name, camera in self._calibration.cameras.items()
            }
            capture = replace(self._calibration, cameras=cameras, fps=self._fps, points=None)
            write_prepared(folder, chosen_cameras(capture, [*known]) if known else capture)
            return folder

    def frame(self, frame: MultiViewFrame, *, common_seconds: float) -> None:
        """Notes which instant became which frame of the stream."""
        number = self.number(common_seconds)
        entry = {
            "index": frame.index,
            "pts_seconds": round(frame.pts_seconds, 6),
            "recorded_seconds": round(self.stamp(number, common_seconds), 6),
            "captured_unix_seconds": frame.captured_unix_seconds,
            "cameras": [*frame.images],
        }
        self.note(number, FRAMES, json.dumps(entry) + "\n")

    def note(self, number: int, file: str, line: str) -> None:
        """Adds a line to a text of a part.

        Raises:
            StorageError: it cannot be written.
        """
        if number not in self._files:
            self.part(number, {})
        path = _part(self._folder, self._first + number) / file
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
        """Ends all files; what cannot be written any more is left out."""
        for camera in self._cameras:
            camera.close()
        for text in self._texts.values():
            with suppress(OSError):
                text.close()


class CameraRecorder:
    """Keeps the packets of one camera; called from its thread. A failure is told, and ends the recording of it."""

    def __init__(self, recording: Recording, name: str, faults: FaultLog) -> None:
        self._recording, self._name, self._faults = recording, name, faults
        self._output: Any = None
        self._stream: Any = None
        self._coding: tuple[object, ...] | None = None
        self._part = -1
        self._last = -1
        self._failed = False
        self._lock = threading.Lock()

    def keep(self, packet: "Packet", *, shift_seconds: float) -> None:
        """See ``camera.PacketKeeper``."""
        if self._failed or packet.pts is None or packet.time_base is None:
            return
        try:
            with self._lock:
                self._keep(packet, shift_seconds)
        except (load_av().error.FFmpegError, OSError, ValueError, StorageError) as error:
            self._failed = True
            self._tell(error)

    def _tell(self, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or error
        self._faults.say(self._name, "recording", f"is no longer recorded ({reason}); the stream goes on")

    def close(self) -> None:
        """Ends the file."""
        with self._lock:
            try:
                self._finish()
            except (load_av().error.FFmpegError, OSError, ValueError) as error:
                self._tell(error)
            self._failed = True

    def _keep(self, packet: "Packet", shift_seconds: float) -> None:
        assert packet.pts is not None
        pts = float(packet.pts * packet.time_base)
        common = pts + shift_seconds
        number = self._recording.number(common)
        same = self._output is not None and _coding(packet.stream) == self._coding
        begins = packet.is_keyframe and (number > self._part or not same)
        if begins and (new := self._recording.number_after(self._part, common)) is not None:
            self._begin(packet, new)
            number, same = new, True
        if not same or number < self._part:
            return
        stamp = self._recording.stamp(self._part, common)
        behind = 0.0 if packet.dts is None else pts - float(packet.dts * packet.time_base)
        self._write(packet, round(stamp * TICKS), round(behind * TICKS))
        line = f"{self._name},{stamp:.6f},{common:.6f},{int(packet.is_keyframe)}\n"
        self._recording.note(self._part, STAMPS, line)

    def _write(self, packet: "Packet", pts: int, behind: int) -> None:
        """A copy of the packet with other stamps; decoding stamps must rise."""
        copy = load_av().Packet(bytes(packet))
        copy.stream = self._stream
        copy.time_base = Fraction(1, TICKS)
        copy.dts = max(pts - behind, self._last + 1)
        copy.pts = max(pts, copy.dts)
        copy.is_keyframe = packet.is_keyframe
        self._last = copy.dts
        self._output.mux(copy)

    def _begin(self, packet: "Packet", number: int) -> None:
        self._finish()
        codec = packet.stream.codec_context.name
        suffix, kind = ("ts", "mpegts") if codec in TRANSPORTED else ("mkv", "matroska")
        name = f"{self._name}.{suffix}"
        folder = self._recording.part(number, {self._name: name})
        self._output = load_av().open(str(folder / name), "w", format=kind, options={"flush_packets": "1"})
        self._stream = self._output.add_stream_from_template(packet.stream)
        self._coding, self._part, self._last = _coding(packet.stream), number, -1

    def _finish(self) -> None:
        if self._output is not None:
            output, self._output = self._output, None
            output.close()


def _coding(stream: Any) -> tuple[object, ...]:
    """What a file states once for all of its packets."""
    context = stream.codec_context
    return context.name, context.width, context.height, bytes(context.extradata or b"")


def _part(folder: Path, number: int) -> Path:
    return folder if number == 0 else folder / f"part-{number:03d}"
