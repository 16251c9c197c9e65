# SPDX-License-Identifier: Apache-2.0
"""The answers to requests for a stream's files."""

import asyncio
import gzip
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import Request
from starlette.types import Message

from segment_folders import GrowingFolder
from streams import small_stream
from structgstream.server.access import Refused
from structgstream.server.catalog import Catalog, ServedStream
from structgstream.server.file_cache import PIECE_BYTES
from structgstream.server.metrics import Metrics
from structgstream.server.serving import YEAR_SECONDS, Serving
from structgstream.server.settings import Limits
from structgstream.server.streams import Streams

STREAM = small_stream(4)
PNG = b"\x89PNG\r\n\x1a\n"


@dataclass
class Told:
    """What a client is sent."""

    status: int
    headers: dict[str, str]
    body: bytes
    answered: tuple[str, str]


class Bench:
    """Streams of a folder, and their answers.

    Args:
        folder: holds the live stream ``studio`` and the file ``ball.sgs``.
        limits: of those who wait.
        visible: to caches on the way.
    """

    def __init__(self, folder: Path, *, limits: Limits | None = None, visible: str = "public") -> None:
        self.growing = GrowingFolder(folder / "studio", STREAM)
        self.growing.write()
        (folder / "ball.sgs").write_bytes(STREAM)
        self.metrics, self.limits, self.visible = Metrics(), limits or Limits(wait_seconds=0.2), visible
        self.folder = folder

    def found(self) -> dict[str, ServedStream]:
        return dict(Catalog(self.folder).found)

    def together(self, *asked: tuple[str, dict[str, str], str], apart: bool = False) -> list[Told]:
        """Answers to requests ``stream/file``, headers, method at the same time, ``apart``: one begun after another."""

        async def run() -> list[Told]:
            streams = Streams(Catalog(self.folder), render=None)
            serving = Serving(streams, self.metrics, self.limits, headers={"X-All": "1"}, visible=self.visible)
            running = []
            for one in asked:
                running.append(asyncio.create_task(self._ask(serving, *one)))
                for _ in range(3 if apart else 0):  # so that it has begun, though it looks at no file yet
                    await asyncio.sleep(0)
            return await asyncio.gather(*running)

        return asyncio.run(run())

    def ask(self, address: str, *, method: str = "GET", **headers: str) -> Told:
        return self.together((address, {name.replace("_", "-"): text for name, text in headers.items()}, method))[0]

    async def _ask(self, serving: Serving, address: str, headers: dict[str, str], method: str) -> Told:
        path, _, query = address.partition("?")
        name, _, file = path.partition("/")
        scope: dict[str, Any] = {
            "type": "http", "method": method, "query_string": query.encode(), "client": ("192.0.2.1", 1),
            "headers": [(key.lower().encode(), value.encode()) for key, value in headers.items()],
        }  # fmt: skip
        sent: list[Message] = []

        async def receive() -> Message:
            await asyncio.Event().wait()
            raise AssertionError

        async def send(message: Message) -> None:
            sent.append(message)

        response = await serving.answer(self.found()[name], file, Request(scope, receive))
        await response(scope, receive, send)
        told = {key.decode(): value.decode() for key, value in sent[0]["headers"]}
        body = b"".join(message.get("body", b"") for message in sent[1:])
        return Told(sent[0]["status"], told, body, scope.get("answered", ("", "")))


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def init_file(bench: Bench) -> str:
    assert bench.growing.manifest is not None
    return bench.growing.manifest.periods[0].file


def test_an_immutable_file(bench: Bench) -> None:
    file = init_file(bench)
    content = (bench.folder / "studio" / file).read_bytes()
    told = bench.ask(f"studio/{file}")
    assert (told.status, told.body, told.answered) == (200, content, ("studio", "init"))
    assert told.headers["cache-control"] == f"public, max-age={YEAR_SECONDS}, immutable"
    assert told.headers["content-type"] == "application/octet-stream"
    assert (told.headers["content-length"], told.headers["x-all"]) == (str(len(content)), "1")
    part = bench.ask(f"studio/{file}", Range="bytes=10-19")
    assert (part.status, part.body) == (206, content[10:20])
    head = bench.ask(f"studio/{file}", method="HEAD")
    assert (head.status, head.body, head.headers["content-length"]) == (200, b"", str(len(content)))
    known = bench.ask(f"studio/{file}", If_None_Match=told.headers["etag"])
    assert (known.status, known.body) == (304, b"")
    beyond = bench.ask(f"studio/{file}", Range=f"bytes={len(content)}-")
    assert (beyond.status, beyond.body, beyond.headers["content-range"]) == (416, b"", f"bytes */{len(content)}")


def test_with_tokens_caches_on_the_way_keep_nothing(tmp_path: Path) -> None:
    bench = Bench(tmp_path, visible="private")
    assert bench.ask(f"studio/{init_file(bench)}").headers["cache-control"].startswith("private, max-age")
    assert bench.ask("studio/manifest.json").headers["cache-control"] == "private, no-cache"


def test_a_history_page_is_json(bench: Bench) -> None:
    page = f"history-00000000-{'a' * 16}.json"
    (bench.folder / "studio" / page).write_text("{}")
    assert bench.ask(f"studio/{page}").headers["content-type"] == "application/json"


def test_the_manifest(bench: Bench) -> None:
    content = (bench.folder / "studio" / "manifest.json").read_bytes()
    plain, zipped = bench.ask("studio/manifest.json"), bench.ask("studio/manifest.json", Accept_Encoding="gzip")
    assert (plain.body, gzip.decompress(zipped.body)) == (content, content)
    assert zipped.headers["content-encoding"] == "gzip"
    assert "content-encoding" not in plain.headers
    assert plain.headers["etag"] != zipped.headers["etag"]
    assert (plain.headers["cache-control"], plain.headers["vary"]) == ("no-cache", "Accept-Encoding")
    for etag in (plain.headers["etag"], zipped.headers["etag"]):
        assert bench.ask("studio/manifest.json", If_None_Match=etag).status == 304
    assert bench.metrics.viewers.counts() == {"studio": 1}


def test_one_waiter_too_many_gets_what_there_is(tmp_path: Path) -> None:
    bench = Bench(tmp_path, limits=Limits(wait_seconds=0.5, waiters=1))
    sequence = json.loads((bench.folder / "studio" / "manifest.json").read_bytes())["sequence"]
    waited, told = bench.together(*[(f"studio/manifest.json?after={sequence}", {}, "GET")] * 2, apart=True)
    assert (waited.status, "retry-after" in waited.headers) == (200, False)
    assert (told.status, told.headers["retry-after"]) == (200, "2")
    assert "retry-after" not in bench.ask("studio/manifest.json").headers
    with pytest.raises(Refused, match="not a sequence number"):
        bench.ask("studio/manifest.json?after=x")


def test_a_head_does_not_wait(tmp_path: Path) -> None:
    bench = Bench(tmp_path, limits=Limits(wait_seconds=1000.0))
    assert bench.ask("studio/manifest.json?after=9", method="HEAD").status == 200


def test_a_stream_that_is_one_file(bench: Bench) -> None:
    whole = bench.ask("ball.sgs/stream.sgs")
    assert (whole.status, whole.body, whole.answered) == (200, STREAM, ("ball.sgs", "file"))
    assert "etag" not in whole.headers
    assert bench.ask("ball.sgs/stream.sgs", Range="bytes=-7").body == STREAM[-7:]
    assert json.loads(bench.ask("ball.sgs/state").body) == {"bytes": len(STREAM), "complete": True}
    (bench.folder / "ball.sgs").write_bytes(STREAM[:-1])
    assert json.loads(bench.ask("ball.sgs/state").body) == {"bytes": len(STREAM) - 1, "complete": False}
    head = bench.ask("ball.sgs/stream.sgs", method="HEAD")
    assert (head.body, head.headers["content-length"]) == (b"", str(len(STREAM) - 1))
    assert bench.ask("ball.sgs/stream.sgs", Range=f"bytes={len(STREAM)}-").status == 416


def test_a_large_file_comes_in_pieces(bench: Bench) -> None:
    content = os.urandom(2 * PIECE_BYTES + 3)
    (bench.folder / "ball.sgs").write_bytes(content)
    assert bench.ask("ball.sgs/stream.sgs").body == content
    assert bench.ask("ball.sgs/stream.sgs", Range=f"bytes=1-{PIECE_BYTES + 1}").body == content[1 : PIECE_BYTES + 2]


@pytest.mark.parametrize(
    "address",
    [
        "ball.sgs/manifest.json", "ball.sgs/", "ball.sgs/init-0000-0123456789abcdef.sgs", "studio/stream.sgs",
        "studio/state", "studio/init-0000-0123456789abcdef.sgs", "studio/.writer", "studio/other.txt",
    ],
)  # fmt: skip
def test_what_is_not_there(bench: Bench, address: str) -> None:
    told = bench.ask(address)
    assert (told.status, told.headers["x-all"]) == (404, "1")
    assert "has no such file" in told.body.decode()


def test_a_stream_that_goes_meanwhile(bench: Bench) -> None:
    found = bench.found()
    (bench.folder / "ball.sgs").unlink()
    (bench.folder / "studio" / "manifest.json").unlink()
    bench.found = lambda: found
    assert bench.ask("ball.sgs/stream.sgs").status == 404
    assert bench.ask("studio/manifest.json").status == 404


def test_a_preview(bench: Bench) -> None:
    none = bench.ask("ball.sgs/preview")
    assert (none.status, none.headers["retry-after"]) == (404, "30")
    (bench.folder / "ball.preview.png").write_bytes(PNG)
    told = bench.ask("ball.sgs/preview")
    assert (told.status, told.body, told.headers["content-type"]) == (200, PNG, "image/png")
    assert told.headers["cache-control"] == "public, max-age=30"
    assert bench.ask("ball.sgs/preview", If_None_Match=told.headers["etag"]).status == 304


def test_nothing_stays_open(bench: Bench) -> None:
    (bench.folder / "studio" / f"segment-00000009-{'a' * 16}.sgs").write_bytes(bytes(5 * 10**6))  # is not cached
    file = f"studio/segment-00000009-{'a' * 16}.sgs"
    before = len(os.listdir("/proc/self/fd"))
    for headers in ({}, {"If_None_Match": f'"{"a" * 16}"'}, {"Range": "bytes=9999999-"}):
        for method in ("GET", "HEAD"):
            bench.ask(file, method=method, **headers)
            bench.ask("ball.sgs/stream.sgs", method=method, **headers)
    assert len(os.listdir("/proc/self/fd")) == before
