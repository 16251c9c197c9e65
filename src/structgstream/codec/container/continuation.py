# SPDX-License-Identifier: Apache-2.0
"""Where a stream file that was cut can be continued (docs/bitstream.md, Writing, cutting and resuming)."""

import math
from dataclasses import replace

from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.damage import PacketSearch, Standing
from structgstream.codec.container.records import (
    PREFIX,
    RecordType,
    check_prefix,
    incomplete_reason,
    may_be_prefix,
    scan_records,
)
from structgstream.errors import StreamError


def readable_part(data: ByteSource, *, name: str) -> int | None:
    """End of the last whole packet, before the index; None if the file is truncated within the init record.

    Raises:
        StreamError: not a stream, another major version, or a damaged init record, after which restarting would
            destroy frames.
    """
    if may_be_prefix(data[: PREFIX.size + 1]):
        return None  # Cut within the prefix, or empty.
    check_prefix(data, name)
    end, standing, complete = PREFIX.size, Standing(PREFIX.size, 0, -math.inf), False
    for record in scan_records(data):
        if complete := record.type == RecordType.INDEX:
            break
        standing = replace(standing, offset=record.end)
        if record.type == RecordType.INIT and record.offset > PREFIX.size:
            standing = replace(standing, period=record.period)
            continue  # What a period begins with is written with its first packet, and again when that is cut.
        end = record.end
        if record.type == RecordType.INIT:
            standing = replace(standing, period=record.period)
        elif record.type in (RecordType.KEY, RecordType.DELTA):
            standing = replace(standing, frames=standing.frames + 1)
    # A crash cannot leave whole frames after a damaged one; a failing disk can.
    lost = not complete and PacketSearch(data).next(standing.offset, standing) is not None
    if end > PREFIX.size:
        if lost:
            raise StreamError(
                f"Cannot continue {name}: {incomplete_reason(data, standing.offset)}, and continuing would overwrite "
                f"the whole frames after it. Keep a copy, then truncate the file to {end} bytes and use --resume to "
                "fit them again."
            )
        return end
    reason = incomplete_reason(data, end)
    if lost or "damaged" in reason:
        raise StreamError(f"Cannot continue {name}: {reason}. Keep a copy; then start again with --overwrite.")
    return None
