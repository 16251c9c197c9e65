# SPDX-License-Identifier: Apache-2.0
"""The ``Range`` header of a request for bytes (RFC 9110, section 14)."""

import re

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
