# SPDX-License-Identifier: Apache-2.0
"""Players without a picture: they follow a live stream over HTTP as the player does, and check every byte.

``python -m lab.robustness.load_players ADDRESS --fast N --slow N --seconds S`` prints what each got, as JSON.
"""

import argparse
import asyncio
import hashlib
import json
import socket
import time
from dataclasses import asdict, dataclass, field
from typing import Any
from urllib.parse import urlsplit

SLOW_BYTES_PER_SECOND = 10_000
SLOW_TURN_SECONDS = 0.1


@dataclass
class Got:
    """What one player has.

    Attributes:
        frames: number of frames from frame 0 on.
        digest: SHA-256 of the init record and their records.
        bytes: of all bodies.
        joined_seconds: from its start until it had all frames that there were.
        delays_seconds: from a frame's publication until it was here, once joined.
        wrong: what was not as the manifest says.
        broken: connections that the server closed in the middle of an answer.
    """

    frames: int = 0
    digest: str = ""
    bytes: int = 0
    joined_seconds: float | None = None
    delays_seconds: list[float] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    broken: int = 0


class Refused(ConnectionError):
    """The server answered, and did not give what was asked for."""


class Connection:
    """A connection that is kept for one request after the other.

    Args:
        address: of the stream, with a slash at its end.
        slow: take :data:`SLOW_BYTES_PER_SECOND`, and let the system keep little.
    """

    def __init__(self, address: str, *, slow: bool) -> None:
        parts = urlsplit(address)
        self._host, self._port, self._base = parts.hostname or "", parts.port or 80, parts.path
        self._slow = slow
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self.bytes = 0

    async def get(self, name: str, *, first: int = 0) -> bytes:
        """The body of an answer, from byte ``first`` on.

        Raises:
            ConnectionError: the server closed the connection, or cannot be reached.
            Refused: it answered with another status.
        """
        if self._streams is None:
            self._streams = await self._opened()
        reader, writer = self._streams
        extra = f"Range: bytes={first}-\r\n" if first else ""
        writer.write(f"GET {self._base}{name} HTTP/1.1\r\nHost: {self._host}\r\n{extra}\r\n".encode())
        try:
            head = (await reader.readuntil(b"\r\n\r\n")).lower()
            length = int(head.partition(b"content-length:")[2].partition(b"\r\n")[0] or b"0")
            body = await self._body(reader, 0 if head.split(b" ", 2)[1] == b"304" else length)
        except asyncio.IncompleteReadError as error:
            raise ConnectionResetError("closed in the middle") from error
        if head.split(b" ", 2)[1] not in (b"200", b"206", b"304"):
            raise Refused(f"{name}: {head[:40].decode()}")
        return body

    async def _body(self, reader: asyncio.StreamReader, length: int) -> bytes:
        pieces, left = [], length
        while left:
            most = int(SLOW_BYTES_PER_SECOND * SLOW_TURN_SECONDS) if self._slow else 2**18
            piece = await reader.read(min(left, most))
            if not piece:
                raise asyncio.IncompleteReadError(b"", left)
            pieces.append(piece)
            left -= len(piece)
            self.bytes += len(piece)
            if self._slow:
                await asyncio.sleep(SLOW_TURN_SECONDS * len(piece) / most)
        return b"".join(pieces)

    async def _opened(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        connecting = socket.socket()
        if self._slow:
            connecting.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connecting.setblocking(False)
        await asyncio.get_running_loop().sock_connect(connecting, (self._host, self._port))
        return await asyncio.open_connection(sock=connecting, limit=4096 if self._slow else 2**18)

    def close(self) -> None:
        """Closes it."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def follow(address: str, got: Got, *, slow: bool) -> None:
    """Plays until it is cancelled."""
    connection, began = Connection(address, slow=slow), time.monotonic()
    total = hashlib.sha256()
    sequence: int | None = None
    try:
        while True:
            try:
                query = "" if sequence is None else f"?after={sequence}"
                manifest = json.loads(await connection.get(f"manifest.json{query}"))
                if sequence is None:
                    total.update(await _checked(connection, manifest["periods"][0], got))
                    sequence = 0
                await _catch_up(connection, manifest, got, total)
            except ConnectionError as error:
                got.broken += isinstance(error, ConnectionResetError)
                got.wrong += [str(error)] if isinstance(error, Refused) else []
                connection.close()
                await asyncio.sleep(0.5)
                continue
            finally:
                got.bytes, got.digest = connection.bytes, total.hexdigest()
            newer, sequence = manifest["sequence"] > sequence, manifest["sequence"]
            if got.joined_seconds is None:
                got.joined_seconds = time.monotonic() - began
            elif newer:
                got.delays_seconds.append(time.time() - manifest["edge"]["published_unix_seconds"])
            if not manifest["live"]:
                return
    finally:
        connection.close()


async def _catch_up(connection: Connection, manifest: dict[str, Any], got: Got, total: "hashlib._Hash") -> None:
    """Gets the frames that a manifest or a history page lists and the player lacks."""
    for entry in manifest.get("history", ()):
        if entry["first_frame"] + entry["frames"] > got.frames:
            page = json.loads(await _checked(connection, entry, got))
            await _catch_up(connection, page, got, total)
    for entry in manifest.get("segments", ()):
        have = got.frames - entry["first_frame"]
        if have >= entry["frames"]:
            continue
        assert have >= 0, "the stream was followed from its first frame"
        if have == 0:
            total.update(await _checked(connection, entry, got))
        else:
            first = sum(entry["frame_bytes"][:have])
            rest = await connection.get(entry["file"], first=first)
            got.wrong += [f"part of {entry['file']}"] if len(rest) != entry["bytes"] - first else []
            total.update(rest)
        got.frames = entry["first_frame"] + entry["frames"]
    for entry in manifest.get("parts", ()):
        if entry["frame"] == got.frames:
            total.update(await _checked(connection, entry, got))
            got.frames += 1


async def _checked(connection: Connection, entry: dict[str, Any], got: Got) -> bytes:
    content = await connection.get(entry["file"])
    if hashlib.sha256(content).hexdigest() != entry["sha256"]:
        got.wrong.append(entry["file"])
    return content


async def play(address: str, *, fast: int, slow: int, seconds: float) -> dict[str, list[Got]]:
    """All players at once, for so long."""
    kinds = {"fast": [Got() for _ in range(fast)], "slow": [Got() for _ in range(slow)]}
    playing = [asyncio.create_task(follow(address, one, slow=kind == "slow")) for kind in kinds for one in kinds[kind]]
    await asyncio.wait(playing, timeout=seconds)
    for task in playing:
        task.cancel()
    outcomes = await asyncio.gather(*playing, return_exceptions=True)
    for outcome in outcomes:
        if isinstance(outcome, Exception):
            raise outcome
    return kinds


def main() -> None:
    """Plays, and prints what each player got."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("address")
    parser.add_argument("--fast", type=int, default=100)
    parser.add_argument("--slow", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    found = asyncio.run(play(options.address, fast=options.fast, slow=options.slow, seconds=options.seconds))
    got = {kind: [asdict(one) for one in players] for kind, players in found.items()}
    print(json.dumps({**got, "processor_seconds": time.process_time()}))


if __name__ == "__main__":
    main()
