# SPDX-License-Identifier: Apache-2.0
"""Responses of bytes: ranges (RFC 9110, section 14), validators, and files sent in pieces."""

import hashlib
import re
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from anyio import to_thread
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from structgstream.errors import StreamError

PIECE_BYTES: Final = 256 * 1024
"""Bytes of a file that are in memory per connection."""

NO_STORE_HEADERS: Final[Mapping[str, str]] = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # The page's address may contain a token.
    "X-Content-Type-Options": "nosniff",
}
_ONE_RANGE = re.compile(r"bytes=\s*(\d{0,18})-(\d{0,18})\s*", re.ASCII | re.IGNORECASE)


class UnsatisfiableRange(Exception):
    """The range starts after the last byte."""


def requested_range(header: str | None, size_bytes: int) -> range | None:
    """The bytes of ``size_bytes`` that a ``Range`` header requests.

    Multiple ranges, other units and malformed headers count as no range; a server may always answer with all bytes.

    Returns:
        offsets of the first byte and the one after the last; None for all.

    Raises:
        UnsatisfiableRange: none of the bytes exists.
    """
    found = _ONE_RANGE.fullmatch(header) if header else None
    if found is None or not any(found.groups()):
        return None
    first, last = found.groups()
    if not first:
        asked = range(max(size_bytes - int(last), 0), size_bytes)
    else:
        if last and int(last) < int(first):
            return None
        asked = range(int(first), min(int(last) + 1, size_bytes) if last else size_bytes)
    if not asked:
        raise UnsatisfiableRange
    return asked


@dataclass(frozen=True)
class Part:
    """The answer to a request for bytes: status, headers, and the offsets of the bytes."""

    status: int
    headers: Mapping[str, str]
    wanted: range


def requested_part(request: Mapping[str, str], size_bytes: int, *, etag: str | None = None) -> Part:
    """The answer to a request for some or all of ``size_bytes`` bytes: 200, 206, or 416 without bytes.

    Args:
        request: headers by their names in lower case.
        etag: strong validator of the bytes. Without one a request with ``If-Range`` gets all of them, because the
            version of its part is unknown.
    """
    valid = "if-range" not in request or (etag is not None and request["if-range"] == etag)
    try:
        asked = requested_range(request.get("range") if valid else None, size_bytes)
    except UnsatisfiableRange:
        return Part(416, {"Accept-Ranges": "bytes", "Content-Range": f"bytes */{size_bytes}"}, range(0))
    wanted = range(size_bytes) if asked is None else asked
    headers = {"Accept-Ranges": "bytes", "Content-Length": str(len(wanted))}
    if asked is not None:
        headers["Content-Range"] = f"bytes {wanted.start}-{wanted.stop - 1}/{size_bytes}"
    return Part(200 if asked is None else 206, headers, wanted)


def etag_matches(headers: Mapping[str, str], etag: str) -> bool:
    """Whether ``If-None-Match`` names the validator, so that the client has the content already."""
    given = headers.get("if-none-match", "")
    names = {name.strip().removeprefix("W/") for name in given.split(",")}
    return given.strip() == "*" or etag in names


class OpenBytes(Protocol):
    """An open file, or a file stored as segments."""

    def __len__(self) -> int: ...

    def __getitem__(self, key: slice, /) -> bytes: ...

    def close(self) -> None: ...


def file_response(
    opened: OpenBytes,
    request: Request,
    headers: Mapping[str, str],
    *,
    etag: str | None = None,
    media_type: str = "application/octet-stream",
) -> Response:
    """The response to a request for a file or a range of it; closes the file.

    Args:
        opened: the file at its current length.
    """
    if etag is not None:
        headers = {**headers, "ETag": etag}
        if etag_matches(request.headers, etag):
            opened.close()
            return Response(status_code=304, headers=headers)
    part = requested_part(request.headers, len(opened), etag=etag)
    headers = {**headers, **part.headers}
    if part.status == 416 or request.method == "HEAD":
        opened.close()
        return Response(status_code=part.status, headers=headers, media_type=media_type)
    return StreamingResponse(_pieces(opened, part.wanted), part.status, headers, media_type)


async def _pieces(opened: OpenBytes, wanted: range) -> AsyncIterator[bytes]:
    """The bytes ``wanted`` of a file, which is closed afterwards; fewer if the file becomes shorter."""
    try:
        for start in range(wanted.start, wanted.stop, PIECE_BYTES):
            end = min(start + PIECE_BYTES, wanted.stop)
            piece = await to_thread.run_sync(opened.__getitem__, slice(start, end))
            yield piece
            if len(piece) < end - start:
                return
    except StreamError:
        return
    finally:
        opened.close()


def content_response(content: bytes, request: Request, headers: Mapping[str, str], *, media_type: str) -> Response:
    """The response to a request for small content that changes, with its digest as validator."""
    etag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    headers = {**headers, "ETag": etag}
    if etag_matches(request.headers, etag):
        return Response(status_code=304, headers=headers)
    return Response(content, headers=headers, media_type=media_type)
