# SPDX-License-Identifier: Apache-2.0
"""Periods: the parts of a stream that have an init record of their own (docs/bitstream.md, section Periods)."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Period:
    """Where a period begins.

    Args:
        number: as stated by its records; 0 for the first of a stream.
        first_frame: its first whole packet's.
        offset: of its init record.
        bytes: of its init record.
    """

    number: int
    first_frame: int
    offset: int
    bytes: int


def period_at(periods: Sequence[Period], frame: int) -> int:
    """The place in ``periods`` of the one that a frame belongs to."""
    return max(bisect_right(periods, frame, key=lambda period: period.first_frame) - 1, 0)
