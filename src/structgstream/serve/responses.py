# SPDX-License-Identifier: Apache-2.0
"""Responses of bytes: ranges (RFC 9110, section 14), validators, and files sent in pieces."""

import hashlib
import re
from collections.abc import AsyncIterator, Mapping
from typing import Final

from anyio import to_thread
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.segments.stored_bytes import StoredBytes
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


def requested_range(header: str | None, size_bytes: int) -> range | None:
    """The offsets of the bytes of ``size_bytes`` that a ``Range`` header requests; empty if none of them exists.

    None for all: also for multiple ranges, other units and malformed headers, as a server may always answer with all.
    """
    found = _ONE_RANGE.fullmatch(header) if header else None
    if found is None or not any(found.groups()):
        return None
    first, last = found.groups()
    if not first:
        return range(max(size_bytes - int(last), 0), size_bytes)
    if last and int(last) < int(first):
        return None
    return range(int(first), min(int(last) + 1, size_bytes) if last else size_bytes)


def etag_matches(headers: Mapping[str, str], etag: str) -> bool:
    """Whether ``If-None-Match`` names the validator, so that the client has the content already."""
    given = headers.get("if-none-match", "")
    names = {name.strip().removeprefix("W/") for name in given.split(",")}
    return given.strip() == "*" or etag in names


def file_response(
    opened: FileBytes | StoredBytes,
    request: Request,
    headers: Mapping[str, str],
    *,
    etag: str | None = None,
    media_type: str = "application/octet-stream",
) -> Response:
    """The response to a request for a file or a range of it; closes the file."""
    if etag is not None:
        headers = {**headers, "ETag": etag}
        if etag_matches(request.headers, etag):
            opened.close()
            return Response(status_code=304, headers=headers)
    # Without a validator the version of the client's part is unknown.
    valid = "if-range" not in request.headers or (etag is not None and request.headers["if-range"] == etag)
    size_bytes = len(opened)
    wanted = requested_range(request.headers.get("range"), size_bytes) if valid else None
    headers = {**headers, "Accept-Ranges": "bytes"}
    if wanted is not None and not wanted:
        status, headers["Content-Range"] = 416, f"bytes */{size_bytes}"
    elif wanted is not None:
        status, headers["Content-Range"] = 206, f"bytes {wanted.start}-{wanted.stop - 1}/{size_bytes}"
    else:
        status, wanted = 200, range(size_bytes)
    if status != 416:
        headers["Content-Length"] = str(len(wanted))
    if status == 416 or request.method == "HEAD":
        opened.close()
        return Response(status_code=status, headers=headers, media_type=media_type)
    return StreamingResponse(_pieces(opened, wanted), status, headers, media_type)


async def _pieces(opened: FileBytes | StoredBytes, wanted: range) -> AsyncIterator[bytes]:
    """The bytes ``wanted`` of a file, which is closed afterwards; fewer if the file becomes shorter."""
    try:
        for start in range(wanted.start, wanted.stop, PIECE_BYTES):
            end = min(start + PIECE_BYTES, wanted.stop)
            yield await to_thread.run_sync(opened.__getitem__, slice(start, end))
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
