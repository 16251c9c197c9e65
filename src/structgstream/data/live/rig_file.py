# SPDX-License-Identifier: Apache-2.0
"""The rig file of a live run: where each camera's pictures come from, and their calibration (docs/live.md).

A file that cannot be read, or that does not fit the calibration, is a ``CaptureError`` with file and key.
"""

import re
import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from structgstream.data.text_files import Unreadable, read_toml, reason
from structgstream.errors import CaptureError
from structgstream.remote_folders import shown_address, without_secrets

Parsed = TypeVar("Parsed")
FILE_URL = re.compile(r"^file:(//(?=/))?", re.IGNORECASE)
SCHEME = re.compile(r"^[a-z][a-z0-9+.-]+:", re.IGNORECASE)
RTSP = re.compile(r"^rtsps?:", re.IGNORECASE)


class TimeBase(StrEnum):
    """Which clock states when a picture was taken."""

    ARRIVAL = "arrival"  # that of this machine at arrival, smoothed by time stamps
    STREAM = "stream"  # the time stamps: the cameras share a clock
    UNIX = "unix"  # the time stamps, which are Unix time modulo the container's range


@dataclass(frozen=True)
class LiveCamera:
    """How a camera is read."""

    url: str
    """Whatever PyAV opens: ``rtsp://``, ``udp://``, ``http://``, ``rtp://``, an ``.sdp`` file, a device, a file."""
    offset_seconds: float = 0.0  # added to the times of its pictures
    format: str | None = None
    """The container or device driver, where the URL does not state it (``mpegts``, ``v4l2``); None to probe."""
    options: Mapping[str, str] = field(default_factory=dict)  # of FFmpeg's protocol and demuxer, by name
    follow: bool = False  # whether a file is still being written, so that reading waits at its end

    @property
    def shown_url(self) -> str:
        """The URL without secrets, for messages."""
        return shown_address(self.url)

    @property
    def is_file(self) -> bool:
        """Whether it is a complete file, and not a stream or a device, which may return."""
        if self.follow or self.is_session:
            return False
        path = Path(name := FILE_URL.sub("", self.url))
        if SCHEME.match(name) or path.is_fifo() or path.is_char_device():
            return False
        return self.format is None or path.is_file()

    @property
    def is_session(self) -> bool:
        """Whether the file describes a stream that comes by RTP (SDP)."""
        return self.url.endswith(".sdp") and not SCHEME.match(self.url)


@dataclass(frozen=True)
class LiveRig:
    """The content of a rig file."""

    name: str  # of the stream
    calibration: Path  # folder of the capture that has the cameras' calibration
    cameras: Mapping[str, LiveCamera]  # by name, in the order of the file
    fps: float | None = None
    """Frames per second, stated in the header; None for that of the calibration. Faster cameras give up to 4/3 of it
    (``synchronizer.py``, MIN_SPACING)."""
    clock: TimeBase = TimeBase.ARRIVAL  # which clock states when a picture was taken
    tolerance_seconds: float | None = None
    """Maximum distance of a picture of a set from its instant; None for half a frame period."""
    deadline_seconds: float = 0.5  # how long a set waits for pictures of cameras that are present
    queue_frames: int = 32  # maximum number of pictures of a camera that wait to be matched; the oldest are dropped
    stuck_seconds: float = 5.0  # a camera is absent when its picture has not changed for this time while others did
    silent_seconds: float = 5.0  # a camera without packets for this time is opened again
    start_seconds: float = 30.0  # how long frame 0 waits for all cameras
    end_seconds: float | None = None  # the stream ends when no camera has sent for this time; None for never
    without: tuple[str, ...] = ()  # cameras of the calibration that are not used


def read_rig(path: Path) -> LiveRig:
    """The content of a rig file."""
    try:
        content = read_toml(path)
    except (OSError, Unreadable) as error:
        raise CaptureError(f"The rig file {path} cannot be read ({reason(error)}); docs/live.md shows one.") from None
    entries = content.pop("cameras", None)
    if not isinstance(entries, dict) or not entries:
        raise CaptureError(f"The rig file {path} has no cameras; give each a table [cameras.NAME] with its url.")
    cameras = {name: _parse(LiveCamera, entry, where=f"camera {name!r} of {path}") for name, entry in entries.items()}
    sources: dict[str, str] = {}
    for name, camera in cameras.items():
        if (other := sources.setdefault(repr(replace(camera, offset_seconds=0.0)), name)) != name:
            raise CaptureError(f"Cameras {other!r} and {name!r} of {path} have one url; give each its own.")
    settings = {"name": path.stem, **content, "cameras": cameras}
    rig = _parse(LiveRig, settings, where=f"the rig file {path}")
    own = [name for name, camera in cameras.items() if camera.is_session or RTSP.match(camera.url)]
    if own and rig.clock is not TimeBase.ARRIVAL:
        raise CaptureError(
            f'{path} has clock = "{rig.clock}", and camera {own[0]!r} sends RTP, whose stamps begin anew with each '
            'connection, so they are of no common clock; take clock = "arrival", and offset_seconds where cameras have '
            "other delays."
        )
    return _resolved(rig, path)


def check_cameras(rig: LiveRig, calibrated: Collection[str], path: Path) -> None:
    """Check that the rig file names the cameras of the calibration, each once."""
    if unknown := [name for name in (*rig.cameras, *rig.without) if name not in calibrated]:
        raise CaptureError(
            f"The rig file {path} names camera {unknown[0]!r}, which the calibration {rig.calibration} lacks; its "
            f"cameras are {', '.join(calibrated)}."
        )
    if both := [name for name in rig.without if name in rig.cameras]:
        raise CaptureError(f"The rig file {path} has camera {both[0]!r} under cameras and in without; choose one.")
    if missing := [name for name in calibrated if name not in rig.cameras and name not in rig.without]:
        raise CaptureError(
            f"The rig file {path} lacks camera {missing[0]!r} of the calibration {rig.calibration}; give it a table "
            f"[cameras.{missing[0]}] with its url, or name it in without."
        )


def _resolved(rig: LiveRig, path: Path) -> LiveRig:
    """Files and folders are relative to the rig file; names of devices, which may come with a format, stay."""
    cameras = dict(rig.cameras)
    for name, camera in cameras.items():
        file = path.parent / camera.url
        is_path = camera.is_session or camera.format is None or camera.follow or file.exists()
        if is_path and not SCHEME.match(camera.url):
            cameras[name] = replace(camera, url=str(file))
    return replace(rig, calibration=path.parent / rig.calibration, cameras=cameras)


def _parse(kind: type[Parsed], entry: Any, *, where: str) -> Parsed:
    """A dataclass from a table whose values are checked."""
    if not isinstance(entry, dict):
        raise CaptureError(f"The entry of {where} must be a table, got {without_secrets(repr(entry))}.")
    known = {item.name: item for item in fields(kind)}  # type: ignore[arg-type]
    if unknown := [key for key in entry if key not in known]:
        raise CaptureError(f"There is no key {unknown[0]!r} in {where}; its keys are {', '.join(known)}.")
    for name, item in known.items():
        if name not in entry and item.default is MISSING and item.default_factory is MISSING:
            raise CaptureError(f"The key {name!r} is missing in {where}.")
    return kind(**{key: _checked(key, value, where) for key, value in entry.items()})


def _checked(key: str, value: Any, where: str) -> Any:
    is_valid, convert, expected = CHECKS[key]
    if is_valid(value):
        return convert(value)
    found = "..." if key in ("url", "options") else repr(value)  # these may have a password
    raise CaptureError(f"{key} = {found} in {where} is invalid; expected {expected}.")


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and value != ""


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= sys.float_info.max


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


CHECKS: Mapping[str, tuple[Callable[[Any], bool], Callable[[Any], Any], str]] = {
    "url": (_is_text, str, "a text, such as rtsp://10.0.0.11/stream"),
    "offset_seconds": (_is_number, float, "seconds"),
    "format": (_is_text, str, "the name of a container or device, such as mpegts"),
    "options": (
        lambda value: isinstance(value, dict) and all(map(_is_text, (*value, *value.values()))),
        dict,
        "a table of texts",
    ),
    "follow": (lambda value: isinstance(value, bool), bool, "true or false"),
    "name": (_is_text, str, "a text"),
    "calibration": (_is_text, Path, "the folder of a capture"),
    "cameras": (lambda value: isinstance(value, dict), dict, "a table for each camera"),
    "fps": (_is_positive, float, "frames a second, more than 0"),
    "clock": (lambda value: value in [*TimeBase], TimeBase, "arrival, stream or unix"),
    "queue_frames": (lambda value: type(value) is int and 2 <= value <= 10_000, int, "a whole number from 2 to 10000"),
    "without": (lambda value: isinstance(value, list) and all(map(_is_text, value)), tuple, "a list of names"),
    **{
        f"{key}_seconds": (_is_positive, float, "seconds, more than 0")
        for key in ("tolerance", "deadline", "stuck", "silent", "start", "end")
    },
}
"""By key: whether a value is one, what converts it, and what is expected."""
