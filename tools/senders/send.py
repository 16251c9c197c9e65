# SPDX-License-Identifier: Apache-2.0
"""Sends the bundled clip as live cameras would, with faults on demand:

``python tools/senders/send.py build/rig --transport udp --fps 10 --fault cam03:cut:20:10``

Each camera's twelve frames are coded once and sent in a loop, as MPEG-TS over UDP, TCP or HTTP, or by RTSP, on this
machine, so that ten cameras cost next to nothing. Stamps of MPEG-TS are Unix time, as far as its 33 bits go: with
``clock = "unix"`` a reader knows when each picture was "filmed". ``build/rig/rig.toml`` is the rig file for them.
"""

import argparse
import io
import json
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import av
import numpy as np
from numpy.typing import NDArray

from rtsp import RtspCamera
from structgstream.data.clip import bundled_clip, bundled_clip_path

TICKS = 90_000
WRAP = 2**33
UDP_BYTES = 1316  # seven packets of MPEG-TS
PAUSE_SECONDS = 0.2
HTTP_OK = b"HTTP/1.0 200 OK\r\nContent-Type: video/mp2t\r\n\r\n"


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


@dataclass(frozen=True)
class Loop:
    """A short video whose first frame is a key frame, coded once.

    Args:
        template: stream of the coded video.
        packets: of one round, in the order of showing, which is that of coding.
    """

    template: Any
    packets: Sequence[bytes]

    @classmethod
    def of(cls, pictures: Sequence[NDArray[np.uint8]], *, codec: str = "libx264") -> "Loop":
        """Pictures ``[H, W, 3]`` of even sizes, without frames that refer to later ones."""
        height, width = pictures[0].shape[:2]
        container = av.open(io.BytesIO(), "w", format="mpegts")
        options = {"preset": "veryfast", "tune": "zerolatency", "crf": "18"}
        stream: Any = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.gop_size = len(pictures)
        packets = []
        for number, picture in enumerate([*pictures, None]):
            frame = None if picture is None else av.VideoFrame.from_ndarray(picture, format="rgb24")
            if frame is not None:
                frame.pts, frame.time_base = number, Fraction(1, 30)
            packets += [bytes(packet) for packet in stream.encode(frame) if packet.size]
        return cls(stream, packets)


class Line(Protocol):
    """Where the bytes of a camera go."""

    def write(self, data: bytes, /) -> int: ...

    def close(self) -> None: ...


class Udp:
    """Datagrams to a port of this machine."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = ("127.0.0.1", port)

    def write(self, data: bytes) -> int:
        for start in range(0, len(data), UDP_BYTES):
            self._socket.sendto(data[start : start + UDP_BYTES], self._address)
        return len(data)

    def close(self) -> None:
        self._socket.close()


class Served:
    """Connections to a port of this machine, each of which gets what is written from then on.

    A new connection begins with a key frame, because a muxer begins anew whenever :attr:`fresh` is set.
    """

    def __init__(self, port: int = 0, *, http: bool) -> None:
        self._http = http
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._clients: list[socket.socket] = []
        self._lock = threading.Lock()
        self.fresh = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def write(self, data: bytes) -> int:
        with self._lock:
            clients = [*self._clients]
        for client in clients:
            try:
                client.sendall(data)
            except OSError:
                self._drop(client)
        return len(data)

    def hang_up(self) -> None:
        """Closes the connections; new ones are taken."""
        with self._lock:
            clients, self._clients = self._clients, []
        for client in clients:
            client.close()

    def close(self) -> None:
        self._listener.close()
        self.hang_up()

    def _drop(self, client: socket.socket) -> None:
        with self._lock:
            if client in self._clients:
                self._clients.remove(client)
        client.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
                client.settimeout(2.0)
                if self._http:
                    client.recv(4096)
                    client.sendall(HTTP_OK)
            except OSError:
                if self._listener.fileno() < 0:
                    return
                continue
            with self._lock:
                self._clients.append(client)
            self.fresh.set()


class _Written(io.RawIOBase):
    """A file that a muxer writes: it hands the bytes on, with the presentation time that is wanted.

    A muxer refuses stamps that repeat or go back, so it gets rising ones, and the five bytes that state the time in the
    header of a picture (ISO/IEC 13818-1, 2.4.3.6) are written again here.
    """

    def __init__(self, line: Line) -> None:
        super().__init__()
        self._line = line
        self.ticks: int | None = None

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        packets = bytearray(data)
        for start in range(0, len(packets) - 187, 188):
            header = start + 4 + (packets[start + 4] + 1 if packets[start + 3] & 0x20 else 0)
            begins = packets[start + 1] & 0x40 and packets[header : header + 3] == b"\0\0\1"
            if begins and packets[header + 3] == 0xE0 and self.ticks is not None:
                packets[header + 9 : header + 14] = presentation_time(self.ticks, mark=packets[header + 9] >> 4)
        return self._line.write(bytes(packets))


def presentation_time(ticks: int, *, mark: int = 2) -> bytes:
    """The five bytes of a time in the header of a picture."""
    ticks %= WRAP
    return bytes(
        [
            mark << 4 | (ticks >> 30) << 1 | 1,
            ticks >> 22 & 0xFF,
            (ticks >> 15 & 0x7F) << 1 | 1,
            ticks >> 7 & 0xFF,
            (ticks & 0x7F) << 1 | 1,
        ]
    )


class _Muxer:
    """MPEG-TS of one loop to a line."""

    def __init__(self, loop: Loop, line: Line) -> None:
        options = {"mpegts_copyts": "1", "flush_packets": "1"}
        self._file = _Written(line)
        self._container: Any = av.open(self._file, "w", format="mpegts", options=options)
        self._stream = self._container.add_stream_from_template(loop.template)
        self._count = 0
        self.loop = loop

    def send(self, data: bytes, stamp: float, *, key: bool) -> None:
        packet = av.Packet(data)
        packet.stream, packet.time_base = self._stream, Fraction(1, TICKS)
        packet.pts = packet.dts = self._count = self._count + TICKS // 100
        packet.is_keyframe = key
        self._file.ticks = round(stamp * TICKS)
        self._container.mux_one(packet)


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
    _muxer: _Muxer | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._cut = False

    def send(self, number: int, *, begun: float, now: float) -> None:
        """Sends picture ``number``, filmed at ``begun + number / fps`` Unix time; ``now`` is after that."""
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
            self._muxer = _Muxer(loop, line)
            self._cut = False
            if isinstance(line, Served):
                line.fresh.clear()
        return True


def loops_of(pictures: Sequence[NDArray[np.uint8]], *, codec: str = "libx264") -> dict[str, Loop]:
    """What a camera that films ``pictures`` sends, by the trouble it has."""
    return {
        "": Loop.of(pictures, codec=codec),
        Fault.STUCK.value: Loop.of(pictures[:1], codec=codec),
        Fault.SIZE.value: Loop.of([np.ascontiguousarray(picture[::2, ::2]) for picture in pictures], codec=codec),
        Fault.SHAPE.value: Loop.of([np.ascontiguousarray(picture[:, :-64]) for picture in pictures], codec=codec),
    }


def film(cameras: Sequence[SentCamera], stop: threading.Event, *, seconds: float = float("inf")) -> None:
    """Sends in step until told to stop."""
    begun_unix, begun = time.time(), time.monotonic()
    for number in _numbers():
        due = number / cameras[0].fps
        if due > seconds:
            return
        queue = sorted((due + camera.delay(number), index) for index, camera in enumerate(cameras))
        for at, index in queue:
            if stop.wait(max(begun + at - time.monotonic(), 0)):
                return
            cameras[index].send(number, begun=begun_unix, now=time.time())


def free_port() -> int:
    """A UDP port that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


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
    lines, urls = _lines(options.transport, list(source.rig))
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


def _lines(transport: str, names: Sequence[str]) -> tuple[dict[str, Line | RtspCamera], dict[str, str]]:
    made: dict[str, Callable[[], tuple[Line | RtspCamera, str]]]
    made = {"udp": _udp, "tcp": _tcp, "http": _http, "rtsp": _rtsp}
    pairs = {name: made[transport]() for name in names}
    return {name: line for name, (line, _) in pairs.items()}, {name: url for name, (_, url) in pairs.items()}


def _udp() -> tuple[Line, str]:
    port = free_port()
    return Udp(port), f"udp://127.0.0.1:{port}"


def _tcp() -> tuple[Line, str]:
    served = Served(http=False)
    return served, f"tcp://127.0.0.1:{served.port}"


def _http() -> tuple[Line, str]:
    served = Served(http=True)
    return served, f"http://127.0.0.1:{served.port}/"


def _rtsp() -> tuple[RtspCamera, str]:
    camera = RtspCamera()
    return camera, camera.url


def _numbers() -> Iterator[int]:
    number = 0
    while True:
        yield number
        number += 1


if __name__ == "__main__":
    main()
