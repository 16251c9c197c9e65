# SPDX-License-Identifier: Apache-2.0
"""Kinds of packets, for those who read bytes and need no torch."""

from enum import IntEnum


class PacketKind(IntEnum):
    """A key packet needs only the header; a delta packet also needs the packet before it."""

    KEY = 1
    DELTA = 2
