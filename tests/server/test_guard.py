# SPDX-License-Identifier: Apache-2.0
"""What every request passes first."""

import asyncio
from dataclasses import dataclass, field
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from structgstream.server.guard import Guard
from structgstream.server.metrics import Metrics
from structgstream.server.settings import PASSING, SAFE_HEADERS, Limits

LIMITS = Limits(requests_per_second=1.0, burst=3, connections_per_address=2, header_bytes=100, query_bytes=10)


@dataclass
class Answering:
    """An application that answers everything, after ``held`` if that is there."""

    asked: list[Scope] = field(default_factory=list)
    held: asyncio.Event | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.asked.append(scope)
        if self.held is not None:
            await self.held.wait()
        scope["answered"] = ("ball", "file")
        await send({"type": "http.response.start", "status": 206, "headers": []})
        await send({"type": "http.response.body", "body": b"12345", "more_body": True})
        await send({"type": "http.response.body", "body": b"67"})


@dataclass
class Told:
    """What a client is sent."""

    status: int
    headers: dict[str, str]
    body: bytes


def scope(**changes: Any) -> Scope:
    plain = {
        "type": "http", "method": "GET", "headers": [], "query_string": b"", "raw_path": b"/streams/ball/x",
        "path": "/streams/ball/x", "client": ("192.0.2.1", 5),
    }  # fmt: skip
    return {**plain, **changes}


async def ask(guard: Guard, **changes: Any) -> Told:
    sent: list[Message] = []

    async def send(message: Message) -> None:
        sent.append(message)

    async def receive() -> Message:
        return {"type": "http.disconnect"}

    await guard(scope(**changes), receive, send)
    start, *bodies = sent
    headers = {name.decode(): value.decode() for name, value in start["headers"]}
    return Told(start["status"], headers, b"".join(message["body"] for message in bodies))


def guarded(limits: Limits = LIMITS, **options: Any) -> tuple[Guard, Answering, Metrics]:
    app, metrics = Answering(**options), Metrics()
    return Guard(app, limits=limits, metrics=metrics, clock=lambda: 0.0), app, metrics


def test_answers_are_counted_with_their_bytes() -> None:
    guard, _, metrics = guarded()
    assert asyncio.run(ask(guard)).body == b"1234567"
    assert asyncio.run(ask(guard, method="HEAD", client=None)).status == 206
    assert metrics.requests == {("ball", "file", 206): 2}
    assert metrics.sent_bytes["ball"] == 7
    assert not metrics.refused


@pytest.mark.parametrize(
    ("changes", "status", "reason"),
    [
        ({"method": "POST"}, 405, "method"),
        ({"method": "get"}, 405, "method"),
        ({"headers": [(b"content-length", b"1")]}, 413, "body"),
        ({"headers": [(b"transfer-encoding", b"chunked")]}, 413, "body"),
        ({"query_string": b"q" * 11}, 414, "length"),
        ({"raw_path": b"/" + b"p" * LIMITS.path_bytes}, 414, "length"),
        ({"headers": [(b"x" * 50, b"y" * 51)]}, 431, "header"),
        ({"raw_path": b"/%2e%2e/x"}, 404, "path"),
        ({"raw_path": b"/../x"}, 404, "path"),
    ],
)
def test_what_no_player_asks_for_is_refused(changes: dict[str, Any], status: int, reason: str) -> None:
    guard, app, metrics = guarded()
    told = asyncio.run(ask(guard, **changes))
    assert (told.status, dict(metrics.refused), app.asked) == (status, {reason: 1}, [])
    assert told.headers.get("connection") == ("close" if status in (405, 413, 414, 431) else None)
    assert told.headers.get("allow") == ("GET, HEAD, OPTIONS" if status == 405 else None)
    assert {name.lower(): value for name, value in PASSING.items()}.items() <= told.headers.items()
    assert metrics.requests == {("", "refused", status): 1}
    assert metrics.sent_bytes[""] == len(told.body)


@pytest.mark.parametrize(
    "changes",
    [
        {"method": "OPTIONS"},
        {"headers": [(b"content-length", b"0")]},
        {"query_string": b"q" * 10},
        {"raw_path": b"/" + b"p" * (LIMITS.path_bytes - 1)},
        {"headers": [(b"x" * 50, b"y" * 50)]},
    ],
)
def test_what_just_fits_is_answered(changes: dict[str, Any]) -> None:
    guard, _, metrics = guarded()
    assert asyncio.run(ask(guard, **changes)).status == 206
    assert not metrics.refused


def test_an_address_that_asks_too_often_is_told_when_to_come_back() -> None:
    async def run() -> None:
        guard, app, metrics = guarded()
        for _ in range(3):
            assert (await ask(guard)).status == 206
        told = await ask(guard)
        assert (told.status, told.headers["retry-after"]) == (429, "2")
        assert "asks too often" in told.body.decode()
        assert (await ask(guard, client=("192.0.2.2", 5))).status == 206
        assert metrics.refused == {"requests_per_second": 1}
        assert len(app.asked) == 4

    asyncio.run(run())


def test_an_address_has_so_many_requests_at_a_time() -> None:
    async def run() -> None:
        held = asyncio.Event()
        guard, _, metrics = guarded(Limits(connections_per_address=2), held=held)
        waiting = [asyncio.create_task(ask(guard)) for _ in range(2)]
        await asyncio.sleep(0)
        told = await ask(guard)
        assert (told.status, metrics.refused) == (429, {"requests_at_a_time": 1})
        assert told.headers["retry-after"] == "2"
        held.set()
        assert {(await one).status for one in waiting} == {206}
        assert (await ask(guard)).status == 206

    asyncio.run(run())


def test_a_request_that_fails_or_is_given_up_leaves_room_for_others() -> None:
    async def failing(scope: Scope, receive: Receive, send: Send) -> None:
        raise RuntimeError("no answer")

    async def run() -> None:
        metrics = Metrics()
        guard = Guard(failing, limits=Limits(connections_per_address=1), metrics=metrics)
        for _ in range(3):
            with pytest.raises(RuntimeError, match="no answer"):
                await ask(guard)
        assert metrics.requests == {("", "other", 500): 3}

    asyncio.run(run())


def test_what_is_no_request_is_nobodys() -> None:
    guard, app, metrics = guarded()

    async def nothing() -> Message:
        raise AssertionError

    async def nobody(message: Message) -> None:
        raise AssertionError

    asyncio.run(guard({"type": "lifespan"}, nothing, nobody))
    assert not app.asked
    assert not metrics.requests


def test_refusals_say_nothing_to_other_sites() -> None:
    assert SAFE_HEADERS["Referrer-Policy"] == "no-referrer"
    assert PASSING["Cache-Control"] == "no-store"
