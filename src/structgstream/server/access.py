# SPDX-License-Identifier: Apache-2.0
"""Who may see what."""

import time
from collections.abc import Callable, Mapping

from starlette.requests import Request

from structgstream.server.catalog import ServedStream
from structgstream.server.names import is_stream_name
from structgstream.server.queries import BadQuery, Query, parsed_query
from structgstream.server.streams import Streams
from structgstream.server.tokens import EVERY_STREAM, Access, TokenKeys


class Refused(Exception):
    """A request that is not answered: status, a sentence, and headers."""

    def __init__(self, status: int, text: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(text)
        self.status = status
        self.text = text
        self.headers = headers or {}


_NOTHING_HERE = "There is nothing at this address."
_BEARER = {"WWW-Authenticate": 'Bearer realm="structgstream"'}
_REASONS: Mapping[Access, str] = {
    Access.MISSING: "An access token is needed here.",
    Access.FORGED: "The access token is not one of this server.",
    Access.EXPIRED: "The access token has expired.",
    Access.OTHER_STREAM: "The access token is for another stream.",
}


class Gate:
    """Checks tokens.

    Args:
        keys: what they are checked with; None lets everyone in.
        streams: the server's streams.
        clock: Unix seconds.
    """

    def __init__(self, keys: TokenKeys | None, streams: Streams, *, clock: Callable[[], float] = time.time) -> None:
        self._keys = keys
        self._streams = streams
        self._clock = clock

    def check(self, request: Request, name: str) -> Query:
        """The request's query, if its token opens the stream ``name``.

        Raises:
            Refused: it does not, or the query is malformed.
        """
        query = query_of(request)
        access = self._access(query, name)
        if access is not Access.GRANTED:
            raise _refusal(access)
        return query

    async def stream(self, request: Request) -> ServedStream:
        """The stream that the address names, if the token opens it.

        Raises:
            Refused: it does not, or there is none.
        """
        name = request.path_params["name"]
        self.check(request, name)
        found = await self._streams.named(name) if is_stream_name(name) else None
        if found is None:
            raise Refused(404, _NOTHING_HERE)
        return found

    async def quality(self, request: Request) -> ServedStream:
        """The quality of a stream that the address names, if the token opens the stream.

        Raises:
            Refused: it does not, or there is none.
        """
        stream = await self.stream(request)
        name = f"{stream.name}/{request.path_params['quality']}"
        found = next((own for own in stream.made_of if own.name == name), None)
        if found is None:
            raise Refused(404, _NOTHING_HERE)
        return found

    async def visible(self, request: Request) -> list[ServedStream]:
        """The streams that the token opens.

        Raises:
            Refused: it opens none that could be.
        """
        query = query_of(request)
        streams = [one for one in await self._streams.all() if self._access(query, one.name) is Access.GRANTED]
        if not streams:
            access = self._access(query, EVERY_STREAM)
            if access not in (Access.GRANTED, Access.OTHER_STREAM):
                raise _refusal(access)
        return streams

    def passed_on(self, request: Request) -> str:
        """The query with which a page asks for what it shows: the token, if one is needed."""
        query = query_of(request)
        return f"?token={query.token}" if self._keys is not None and query.token else ""

    def _access(self, query: Query, name: str) -> Access:
        if self._keys is None:
            return Access.GRANTED
        return self._keys.access(query.token, name, unix_seconds=self._clock())


def _refusal(access: Access) -> Refused:
    return Refused(403, _REASONS[access]) if access is Access.OTHER_STREAM else Refused(401, _REASONS[access], _BEARER)


def query_of(request: Request) -> Query:
    """The query of a request.

    Raises:
        Refused: it is malformed.
    """
    try:
        return parsed_query(request.scope["query_string"], request.headers)
    except BadQuery as bad:
        raise Refused(400, str(bad)) from None
