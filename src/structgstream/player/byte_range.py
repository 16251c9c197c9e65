# SPDX-License-Identifier: Apache-2.0
"""The ``Range`` header of a request for bytes (RFC 9110, section 14)."""

import re

_ONE_RANGE = re.compile(r"bytes=\s*(\d{0,18})-(\d{0,18})\s*", re.ASCII | re.IGNORECASE)


class UnsatisfiableRange(Exception):
    """The range begins behind the last byte."""


def requested_range(header: str | None, size_bytes: int) -> range | None:
    """Which bytes of ``size_bytes`` a ``Range`` header asks for.

    Several ranges at once, other units and what is not written as the RFC says count as no range: a server may always
    answer with everything.

    Returns:
        offsets of the first byte and the one after the last; None for all.

    Raises:
        UnsatisfiableRange: none of the bytes is there.
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
