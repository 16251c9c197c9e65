# SPDX-License-Identifier: Apache-2.0
"""Which names may stand in an address.

Note [Plain names]
~~~~~~~~~~~~~~~~~~
Streams and their files have names of letters, digits, dots, dashes and underscores. So every address is written in one
way only, without percent signs, and no address leads out of a folder.
"""

import re
from typing import Final

from structgstream.codec.segments.store import is_ours

MANIFEST: Final = "manifest.json"
STREAM_SUFFIX: Final = ".sgs"

_STREAM = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}", re.ASCII)
_PATH = re.compile(rb"/[A-Za-z0-9._/-]*")


def is_stream_name(name: str) -> bool:
    """Whether a stream of this name can be served."""
    return _STREAM.fullmatch(name) is not None


def hash_in_name(file: str) -> str | None:
    """The 16 hex digits in the name of an immutable file of a segments folder; None for other names."""
    return None if file == MANIFEST or not is_ours(file) else file.rpartition("-")[2].partition(".")[0]


def is_plain_path(raw: bytes) -> bool:
    """Whether a path, as the client wrote it, holds plain names only (Note [Plain names])."""
    return _PATH.fullmatch(raw) is not None and not {b".", b".."} & set(raw.split(b"/"))
