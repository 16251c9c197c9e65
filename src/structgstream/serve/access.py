# SPDX-License-Identifier: Apache-2.0
"""Parses the query of a request and checks its access token."""

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl

from starlette.requests import Request

from structgstream.serve.tokens import Access, TokenKeys

MAX_PARAMETERS: Final = 16
_NUMBER = re.compile(r"[0-9]{1,16}", re.ASCII)
_BEARER = re.compile(r"bearer +([A-Za-z0-9._~+/-]+=*)", re.ASCII | re.IGNORECASE)
_CHALLENGE = {"WWW-Authenticate": 'Bearer realm="structgstream"'}
_REASONS: Mapping[Access, str] = {
    Access.MISSING: "An access token is needed here.",
    Access.FORGED: "The access token is not one of this server.",
    Access.EXPIRED: "The access token has expired.",
    Access.OTHER_STREAM: "The access token is for another stream.",
}


class Refused(Exception):
    """A request is refused; has the response's status, sentence and headers."""

    def __init__(self, status: int, text: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(text)
        self.status = status
        self.text = text
        self.headers = headers or {}


@dataclass(frozen=True)
class Query:
    """The query parameters that the server knows; others are ignored.

    Args:
        token: access token; None if there is none.
        after: sequence of the manifest that the client has; None if it does not wait for a newer one.
    """

    token: str | None
    after: int | None


def parsed_query(raw: bytes, headers: Mapping[str, str]) -> Query:
    """The query of a request; a token in the header ``Authorization`` takes precedence over one in the query.

    Args:
        raw: the query as the client wrote it, without question mark.
        headers: headers by their names in lower case.

    Raises:
        Refused: it has too many parameters, one of them twice, or ``after`` is not a number.
    """
    try:
        pairs = parse_qsl(raw.decode("ascii"), keep_blank_values=True, max_num_fields=MAX_PARAMETERS, errors="strict")
    except ValueError:  # also for bytes that are not UTF-8
        raise Refused(400, f"The query cannot be read, or has more than {MAX_PARAMETERS} parameters.") from None
    values = dict(pairs)
    for name in ("token", "after"):
        if sum(key == name for key, _ in pairs) > 1:
            raise Refused(400, f"The query has {name} twice.")
    if not _NUMBER.fullmatch(values.get("after", "0")):
        raise Refused(400, "The query's after is not a sequence number.")
    bearer = _BEARER.fullmatch(headers.get("authorization", ""))
    return Query(bearer[1] if bearer else values.get("token"), int(values["after"]) if "after" in values else None)


def query_of(request: Request) -> Query:
    """The query of a request.

    Raises:
        Refused: it is malformed.
    """
    return parsed_query(request.scope["query_string"], request.headers)


class Authorizer:
    """Checks the tokens of requests.

    Args:
        keys: secrets; None gives everyone access.
        clock: Unix seconds.
    """

    def __init__(self, keys: TokenKeys | None, *, clock: Callable[[], float] = time.time) -> None:
        self._keys = keys
        self._clock = clock

    def access(self, request: Request, name: str) -> Access:
        """Access of a request to the stream ``name``.

        Raises:
            Refused: the query is malformed.
        """
        query = query_of(request)
        if self._keys is None:
            return Access.GRANTED
        return self._keys.access(query.token, name, unix_seconds=self._clock())

    def check(self, request: Request, name: str) -> None:
        """Check that a request has access to the stream ``name``.

        Raises:
            Refused: it has none, or the query is malformed.
        """
        access = self.access(request, name)
        if access is not Access.GRANTED:
            raise refusal(access)

    def page_query(self, request: Request) -> str:
        """The query that a page adds to the addresses it loads: the token of its own request, if one is needed."""
        token = query_of(request).token
        return f"?token={token}" if self._keys is not None and token else ""


def refusal(access: Access) -> Refused:
    """The answer to a request without access."""
    if access is Access.OTHER_STREAM:
        return Refused(403, _REASONS[access])
    return Refused(401, _REASONS[access], _CHALLENGE)
