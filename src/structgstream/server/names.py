# SPDX-License-Identifier: Apache-2.0
"""Which names may stand in an address.

Note [Plain names]
~~~~~~~~~~~~~~~~~~
Streams and their files have names of letters, digits, dots, dashes and underscores. So every address is written in one
way only, without percent signs, and no address leads out of a folder.
"""

import re
from typing import Final

MANIFEST: Final = "manifest.json"
STREAM_SUFFIX: Final = ".sgs"

_STREAM = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}", re.ASCII)
_IMMUTABLE = re.compile(
    r"(?:(?:init-[0-9]{4,10}|part-[0-9]{8,12}|segment-[0-9]{8,12})-([0-9a-f]{16})\.sgs"
    r"|history-[0-9]{8,12}-([0-9a-f]{16})\.json)",
    re.ASCII,
)
_PATH = re.compile(rb"/[A-Za-z0-9._/-]*")


def is_stream_name(name: str) -> bool:
    """Whether a stream of this name can be served."""
    return _STREAM.fullmatch(name) is not None


def hash_in_name(file: str) -> str | None:
    """The 16 hex digits in the name of an immutable file of a segments folder; None for other names."""
    found = _IMMUTABLE.fullmatch(file)
    return None if found is None else found[1] or found[2]


def is_plain_path(raw: bytes) -> bool:
    """Whether a path, as the client wrote it, holds plain names only (Note [Plain names])."""
    return _PATH.fullmatch(raw) is not None and not {b".", b".."} & set(raw.split(b"/"))
