# SPDX-License-Identifier: Apache-2.0
"""Sends the bundled clip as live cameras would, with faults on demand:

``python tests/support/senders/send.py build/rig --transport udp --fps 10 --fault cam03:cut:20:10``

Each camera's twelve frames are coded once and sent in a loop, as MPEG-TS over UDP, TCP or HTTP, or by RTSP, on this
machine, so that ten cameras cost next to nothing. Stamps of MPEG-TS are Unix time, as far as its 33 bits go: with
``clock = "unix"`` a reader knows when each picture was "filmed". ``build/rig/rig.toml`` is the rig file for them.
"""

import argparse
import json
import random
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera_lines import Line, Served, opened_lines
from mpeg_ts import Loop, Muxer
from rtsp import RtspCamera
from structgstream.data.dataset_layouts import bundled_clip, bundled_clip_path


class Fault(StrEnum):
    """What a camera does wrong for a while."""

    CUT = "cut"  # sends nothing; connections are closed
    SILENT = "silent"  # sends nothing; connections stay
    STUCK = "stuck"  # the same picture again and again
    GARBAGE = "garbage"  # random bytes in place of coded ones
    SIZE = "size"  # half the width and height
    SHAPE = "shape"  # other proportions
    JUMP = "jump"  # stamps 100 s ahead
    BACK = "back"  # stamps 100 s behind
    DRIFT = "drift"  # stamps a thousandth too fast
    JITTER = "jitter"  # each picture up to 60 ms late
    DUPLICATE = "duplicate"  # each picture twice with one stamp
    REORDER = "reorder"  # every second pair of stamps exchanged


@dataclass(frozen=True)
class Trouble:
    """A fault of a camera, from a time after the beginning on, for a while; seconds."""

    camera: str
    fault: Fault
    start: float = 0.0
    length: float = float("inf")

    @classmethod
    def parsed(cls, text: str) -> "Trouble":
        """``CAMERA:FAULT[:START[:LENGTH]]``."""
        camera, fault, *times = text.split(":")
        return cls(camera, Fault(fault), *map(float, times))


@dataclass
class SentCamera:
    """One camera.

    Args:
        name: of the camera.
        loops: what it shows as a rule, and in troubles of the picture.
        line: where it sends.
        fps: pictures a second.
        troubles: its faults.
        seed: of jitter and garbage.
    """

    name: str
    loops: Mapping[str, Loop]
    line: Line | RtspCamera
    fps: float
    troubles: Sequence[Trouble] = ()
    seed: int = 0
    sent: int = 0
    _muxer: Muxer | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._cut = False

    def send(self, number: int, *, begun: float) -> None:
        """Sends picture ``number``, filmed at ``begun + number / fps`` Unix time."""
        since = number / self.fps
        faults = {trouble.fault for trouble in self.troubles if trouble.start <= since < trouble.start + trouble.length}
        if faults & {Fault.CUT, Fault.SILENT}:
            if Fault.CUT in faults and isinstance(self.line, Served | RtspCamera):
                self.line.hang_up()
            self._cut = True
            return
        kind = next((fault.value for fault in (Fault.SIZE, Fault.SHAPE, Fault.STUCK) if fault in faults), "")
        loop = self.loops[kind]
        at = number % len(loop.packets)
        data = loop.packets[at]
        if Fault.GARBAGE in faults:
            data = data[:8] + self._random.randbytes(max(len(data) - 8, 0))
        stamp = begun + self._stamped(number, faults)
        self.sent += 1
        if isinstance(self.line, RtspCamera):
            self.line.send(loop.template, data, stamp, key=at == 0)
            return
        if not self._ready(loop, at, self.line):
            return
        assert self._muxer is not None
        self._muxer.send(data, stamp, key=at == 0)
        if Fault.DUPLICATE in faults:
            self._muxer.send(data, stamp, key=at == 0)

    def delay(self, number: int) -> float:
        """How much later than filmed it is sent, seconds."""
        since = number / self.fps
        late = any(t.fault is Fault.JITTER and t.start <= since < t.start + t.length for t in self.troubles)
        return self._random.uniform(0, 0.06) if late else 0.0

    def _stamped(self, number: int, faults: set[Fault]) -> float:
        if Fault.REORDER in faults:
            number += {1: 1, 2: -1}.get(number % 4, 0)
        stamp = number / self.fps
        shift = {Fault.JUMP: 100.0, Fault.BACK: -100.0, Fault.DRIFT: 0.001 * stamp}
        return stamp + sum(shift.get(fault, 0.0) for fault in faults)

    def _ready(self, loop: Loop, at: int, line: Line) -> bool:
        """Whether a muxer is open; it begins anew with a key frame after a cut, for a new client and another loop."""
        fresh = isinstance(line, Served) and line.fresh.is_set()
        if self._muxer is None or self._muxer.loop is not loop or self._cut or fresh:
            if at:
                return self._muxer is not None and self._muxer.loop is loop and not self._cut
            self._muxer = Muxer(loop, line)
            self._cut = False
            if isinstance(line, Served):
                line.fresh.clear()
        return True


def loops_of(pictures: Sequence[NDArray[np.uint8]]) -> dict[str, Loop]:
    """What a camera that films ``pictures`` sends, by the trouble it has."""
    return {
        "": Loop.of(pictures),
        Fault.STUCK.value: Loop.of(pictures[:1]),
        Fault.SIZE.value: Loop.of([np.ascontiguousarray(picture[::2, ::2]) for picture in pictures]),
        Fault.SHAPE.value: Loop.of([np.ascontiguousarray(picture[:, :-64]) for picture in pictures]),
    }


def film(cameras: Sequence[SentCamera], stop: threading.Event, *, seconds: float = float("inf")) -> None:
    """Sends in step until asked to stop."""
    begun_unix, begun = time.time(), time.monotonic()
    for number in count():
        due = number / cameras[0].fps
        if due > seconds:
            return
        queue = sorted((due + camera.delay(number), index) for index, camera in enumerate(cameras))
        for at, index in queue:
            if stop.wait(max(begun + at - time.monotonic(), 0)):
                return
            cameras[index].send(number, begun=begun_unix)


def rig_text(urls: Mapping[str, str], calibration: Path, **settings: object) -> str:
    """The rig file of these cameras."""
    lines = [f"calibration = {json.dumps(str(calibration))}"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
    for name, url in urls.items():
        further = 'options = {rtsp_transport = "tcp"}' if url.startswith("rtsp:") else 'format = "mpegts"'
        lines += ["", f"[cameras.{name}]", f"url = {json.dumps(url)}", further]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where rig.toml is written")
    parser.add_argument("--transport", choices=("udp", "tcp", "http", "rtsp"), default="udp")
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--clock", choices=("arrival", "stream", "unix"), help="default: unix; arrival for RTSP")
    parser.add_argument(
        "--fault", type=Trouble.parsed, action="append", default=[], metavar="CAMERA:FAULT:START:LENGTH"
    )
    options = parser.parse_args()
    source = bundled_clip()
    frames = [frame.images for frame in source.frames()]
    lines, urls = opened_lines(options.transport, list(source.rig))
    cameras = [
        SentCamera(
            name,
            loops_of([images[name] for images in frames]),
            lines[name],
            options.fps,
            [trouble for trouble in options.fault if trouble.camera == name],
        )
        for name in source.rig
    ]
    options.folder.mkdir(parents=True, exist_ok=True)
    file = options.folder / "rig.toml"
    clock = options.clock or ("arrival" if options.transport == "rtsp" else "unix")
    file.write_text(rig_text(urls, bundled_clip_path(), clock=clock, fps=options.fps))
    print(f"{len(cameras)} cameras send; structgstream reconstruct {file} --live -o live.sgs", flush=True)
    film(cameras, threading.Event(), seconds=options.seconds)


if __name__ == "__main__":
    main()
