# SPDX-License-Identifier: Apache-2.0
"""A camera that is asked by RTSP (RFC 2326), as network cameras are: pictures as RTP inside the connection.

It knows what FFmpeg with ``rtsp_transport = "tcp"`` asks: one video, one or more clients, no password.
"""

import io
import socket
import struct
import threading
from fractions import Fraction
from typing import Any

import av

TICKS = 90_000
DESCRIPTION = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\n"
    "m=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\na=control:track1\r\n"
)
ANSWERS = {
    "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, GET_PARAMETER, TEARDOWN\r\n",
    "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1;timeout=60\r\n",
    "PLAY": "Session: 1\r\n",
    "GET_PARAMETER": "Session: 1\r\n",
    "TEARDOWN": "Session: 1\r\n",
}


class RtspCamera:
    """Serves H.264 packets to who asks."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._clients: dict[socket.socket, _Packets | None] = {}
        self._lock = threading.Lock()
        self.url = f"rtsp://127.0.0.1:{self._listener.getsockname()[1]}/camera"
        threading.Thread(target=self._accept, daemon=True).start()

    def send(self, template: Any, data: bytes, stamp: float, *, key: bool) -> None:
        """Sends a coded picture to the clients that play; each begins with a key frame."""
        with self._lock:
            playing = [(client, packets) for client, packets in self._clients.items() if packets is not None]
        for client, packets in playing:
            try:
                packets.send(template, data, stamp, key=key)
            except (OSError, ValueError):
                self._drop(client)

    def hang_up(self) -> None:
        """Closes the connections; new ones are taken."""
        with self._lock:
            clients = [*self._clients]
        for client in clients:
            self._drop(client)

    def close(self) -> None:
        self._listener.close()
        self.hang_up()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            client.settimeout(120.0)  # twice as long as a session lives without a request
            with self._lock:
                self._clients[client] = None
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        try:
            with client.makefile("rb") as lines:
                while (request := _request(lines)) is not None:
                    method, number = request
                    body = DESCRIPTION if method == "DESCRIBE" else ""
                    head = "Content-Type: application/sdp\r\n" if body else ANSWERS.get(method, "")
                    answer = f"RTSP/1.0 200 OK\r\nCSeq: {number}\r\n{head}Content-Length: {len(body)}\r\n\r\n{body}"
                    client.sendall(answer.encode())
                    if method == "PLAY":
                        with self._lock:
                            self._clients[client] = _Packets(client)
                    if method == "TEARDOWN":
                        return
        except OSError:
            return
        finally:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        with self._lock:
            self._clients.pop(client, None)
        client.close()


class _Packets(io.RawIOBase):
    """RTP packets of one client: a muxer writes one at a time, and each gets its frame (RFC 2326, 10.12)."""

    def __init__(self, client: socket.socket) -> None:
        super().__init__()
        self._client = client
        self._muxer: Any = None
        self._stream: Any = None
        self._first = 0.0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        packet = bytes(data)
        channel = 1 if 192 <= packet[1] <= 223 else 0  # RTCP or RTP (RFC 5761, 4)
        self._client.sendall(b"$" + struct.pack(">BH", channel, len(packet)) + packet)
        return len(packet)

    def send(self, template: Any, data: bytes, stamp: float, *, key: bool) -> None:
        if self._muxer is None:
            if not key:
                return
            self._muxer = av.open(self, "w", format="rtp", options={"packetsize": "1400", "flush_packets": "1"})
            self._stream = self._muxer.add_stream_from_template(template)
            self._first = stamp
        packet = av.Packet(data)
        packet.stream, packet.time_base = self._stream, Fraction(1, TICKS)
        packet.pts = packet.dts = round((stamp - self._first) * TICKS)
        packet.is_keyframe = key
        self._muxer.mux_one(packet)


def _request(lines: Any) -> tuple[str, str] | None:
    """Method and number of the next request; reports of receivers in between are skipped."""
    while True:
        first = lines.read(1)
        if not first:
            return None
        if first == b"$":
            _, length = struct.unpack(">BH", lines.read(3))
            lines.read(length)
            continue
        method, number, size = (first + lines.readline()).decode().split(" ", 1)[0].strip(), "0", 0
        while line := lines.readline().decode().strip():
            name, _, value = line.partition(":")
            number = value.strip() if name.lower() == "cseq" else number
            size = int(value) if name.lower() == "content-length" else size
        lines.read(size)
        if method:
            return method, number
