# SPDX-License-Identifier: Apache-2.0
"""Responses whose bytes come piece by piece, each when the client has taken the one before."""

import asyncio
from collections.abc import AsyncGenerator, Mapping
from contextlib import aclosing

from starlette.responses import Response
from starlette.types import Receive, Scope, Send


class PieceResponse(Response):
    """Sends ``pieces`` and closes them, also when the client goes away meanwhile.

    Args:
        pieces: the content, an asynchronous generator.
        status_code: of the response.
        headers: of the response; ``Content-Length`` among them.
        media_type: of the content.
    """

    def __init__(
        self, pieces: AsyncGenerator[bytes, None], *, status_code: int, headers: Mapping[str, str], media_type: str
    ) -> None:
        super().__init__(None, status_code, headers, media_type)
        self._pieces = pieces

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends the response. uvicorn drops what is sent to a client that is gone, so that is watched for."""
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        gone = asyncio.create_task(client_gone(receive))
        try:
            async with aclosing(self._pieces) as pieces:
                async for piece in pieces:
                    if gone.done():
                        return
                    await send({"type": "http.response.body", "body": piece, "more_body": True})
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        finally:
            gone.cancel()


async def client_gone(receive: Receive) -> None:
    """Returns when the client is gone."""
    while (await receive())["type"] != "http.disconnect":
        pass
