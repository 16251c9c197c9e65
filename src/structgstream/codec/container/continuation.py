# SPDX-License-Identifier: Apache-2.0
"""Where a stream file that was cut can be continued (docs/bitstream.md, Writing, cutting and resuming)."""

import math

from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.damage import PacketSearch
from structgstream.codec.container.records import (
    PREFIX,
    RecordType,
    check_prefix,
    incomplete_reason,
    prefix,
    scan_records,
)
from structgstream.errors import StreamError


def readable_part(data: ByteSource, *, name: str) -> int | None:
    """End of the last whole packet, before the index; None if the file is truncated within the init record.

    Raises:
        StreamError: not a stream, another major version, or a damaged init record, after which restarting would
            destroy frames.
    """
    if prefix().startswith(bytes(data[: PREFIX.size + 1])):
        return None  # Cut within the prefix, or empty.
    check_prefix(data, name)
    end, frames, complete = PREFIX.size, 0, False
    for record in scan_records(data):
        if complete := record.type == RecordType.INDEX:
            break
        end = record.end
        frames += record.type in (RecordType.KEY, RecordType.DELTA)
    # A crash cannot leave whole frames after a damaged one; a failing disk can.
    lost = not complete and PacketSearch(data).next(end, expected=frames, after_seconds=-math.inf) is not None
    if end > PREFIX.size:
        if lost:
            raise StreamError(
                f"Cannot continue {name}: {incomplete_reason(data, end)}, and continuing would overwrite the whole "
                f"frames after it. Keep a copy, then truncate the file to {end} bytes and use --resume to fit them "
                "again."
            )
        return end
    reason = incomplete_reason(data, end)
    if lost or "damaged" in reason:
        raise StreamError(f"Cannot continue {name}: {reason}. Keep a copy; then start again with --overwrite.")
    return None
