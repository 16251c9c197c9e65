# SPDX-License-Identifier: Apache-2.0
"""Responses whose bytes come piece by piece."""

import asyncio
from collections.abc import AsyncGenerator

from starlette.types import Message

from structgstream.server.transfer import PieceResponse, client_gone


class Pieces:
    """Pieces that tell how many were taken, and that they were closed."""

    def __init__(self, count: int) -> None:
        self.count, self.taken, self.closed = count, 0, False

    async def __call__(self) -> AsyncGenerator[bytes, None]:
        try:
            for number in range(self.count):
                self.taken += 1
                yield bytes([number])
        finally:
            self.closed = True


def response(pieces: Pieces) -> PieceResponse:
    headers = {"Content-Length": str(pieces.count)}
    return PieceResponse(pieces(), status_code=206, headers=headers, media_type="application/octet-stream")


def others() -> list[asyncio.Task[None]]:
    """What else runs and is not about to end."""
    return [one for one in asyncio.all_tasks() if one is not asyncio.current_task() and not one.cancelling()]


async def never() -> Message:
    await asyncio.Event().wait()
    raise AssertionError


def test_all_pieces_come_in_their_order() -> None:
    async def run() -> None:
        pieces, sent = Pieces(3), []

        async def send(message: Message) -> None:
            sent.append(message)

        await response(pieces)({"type": "http"}, never, send)
        assert sent[0]["status"] == 206
        assert (b"content-type", b"application/octet-stream") in sent[0]["headers"]
        assert (b"content-length", b"3") in sent[0]["headers"]
        assert [(one["body"], one["more_body"]) for one in sent[1:]] == [
            (b"\0", True), (b"\1", True), (b"\2", True), (b"", False),
        ]  # fmt: skip
        assert pieces.closed
        assert not others()

    asyncio.run(run())


def test_a_piece_is_made_when_the_one_before_has_been_taken() -> None:
    async def run() -> None:
        pieces, takes = Pieces(5), asyncio.Event()

        async def send(message: Message) -> None:
            if message["type"] == "http.response.body":
                await takes.wait()

        task = asyncio.create_task(response(pieces)({"type": "http"}, never, send))
        for _ in range(20):
            await asyncio.sleep(0)
        assert pieces.taken == 1
        takes.set()
        await task
        assert pieces.taken == 5

    asyncio.run(run())


def test_who_goes_away_gets_no_more_and_everything_is_closed() -> None:
    async def run() -> None:
        pieces, left, sent = Pieces(100), asyncio.Event(), 0

        async def receive() -> Message:
            await left.wait()
            return {"type": "http.disconnect"}

        async def send(message: Message) -> None:
            nonlocal sent
            sent += 1
            if sent == 4:
                left.set()
            await asyncio.sleep(0)

        await response(pieces)({"type": "http"}, receive, send)
        assert sent < 10
        assert pieces.closed
        assert not [
            task for task in asyncio.all_tasks() if task is not asyncio.current_task() and not task.cancelling()
        ]

    asyncio.run(run())


def test_a_connection_that_breaks_closes_the_pieces() -> None:
    async def run() -> None:
        pieces = Pieces(3)

        async def send(message: Message) -> None:
            if message["type"] == "http.response.body":
                raise ConnectionResetError

        try:
            await response(pieces)({"type": "http"}, never, send)
        except ConnectionResetError:
            assert pieces.closed
        else:
            raise AssertionError("the error went nowhere")

    asyncio.run(run())


def test_going_away_is_not_any_message() -> None:
    async def run() -> None:
        messages = iter(["http.request", "http.request", "http.disconnect", "more"])

        async def receive() -> Message:
            return {"type": next(messages)}

        await client_gone(receive)
        assert next(messages) == "more"

    asyncio.run(run())
