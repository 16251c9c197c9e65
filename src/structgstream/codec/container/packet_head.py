# SPDX-License-Identifier: Apache-2.0
"""The head of a packet's payload."""

import struct

FRAME = struct.Struct("<Id")  # index, presentation time in seconds
