# SPDX-License-Identifier: Apache-2.0
"""The ``Range`` header of a request for bytes, and what answers it (RFC 9110, section 14)."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

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
    """The answer to a request for bytes: its status, the headers that say which bytes these are, and their offsets."""

    status: int
    headers: Mapping[str, str]
    wanted: range


def requested_part(request: Mapping[str, str], size_bytes: int, *, etag: str | None = None) -> Part:
    """What answers a request for some or all of ``size_bytes`` bytes: 200, 206, or 416 without bytes.

    Args:
        request: headers by their names in lower case.
        size_bytes: how many there are.
        etag: strong validator of the bytes. Without one a request with ``If-Range`` gets all of them, because nobody
            can know which version its part belongs to.
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
