# SPDX-License-Identifier: Apache-2.0
"""The bit rates in the list of qualities: estimated at first, measured as soon as there are enough packets."""

from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import ListedQuality, read_list, write_list
from structgstream.errors import StreamError
from structgstream.qualities.ladder import Quality
from structgstream.session.frame_report import FrameReport

EXPECTED_BITS = 2e6
"""Estimated bits per second of quality 0, from 1.9 and 2.9 Mbit/s in lab/notes/compact-measured.md. Each further unit
of quality doubles it."""
MIN_PACKETS = 5
MAX_PACKETS = 60
"""Number of packets over which a rate is measured: two groups of one second, or more if frames are skipped."""
CHANGE = 0.1
"""The list is rewritten when a rate differs from the listed one by this share."""


class BitRates:
    """Maintains the list of qualities in a folder.

    Args:
        folder: contains the list and a folder of segments for each quality.
        qualities: the listed qualities.
    """

    def __init__(self, folder: Path, qualities: Sequence[Quality]) -> None:
        self._folder = folder
        self._listed = {quality.name: expected_bits(quality) for quality in qualities}
        self._packets = {quality.name: deque[tuple[float, int]](maxlen=MAX_PACKETS + 1) for quality in qualities}

    def begin(self, *, resume: bool) -> None:
        """Writes the list, with the rates of the earlier run if it is resumed.

        Raises:
            StorageError: it cannot be written.
        """
        if resume:
            self._listed |= {name: bits for name, bits in listed_bits(self._folder).items() if name in self._listed}
        self._write()

    def add(self, name: str, report: FrameReport) -> None:
        """Adds a stored frame of a quality to the measurement."""
        self._packets[name].append((report.pts_seconds, report.bytes))

    def refresh(self, *, last: bool = False) -> None:
        """Rewrites the list if a measured rate differs from the listed one.

        Args:
            last: no frame follows, so the rates of any number of packets are listed.

        Raises:
            StorageError: it cannot be written; the earlier list is not affected.
        """
        known = {
            name: bits
            for name, packets in self._packets.items()
            if len(packets) > (1 if last else MIN_PACKETS) and (bits := bits_per_second(packets)) is not None
        }
        share = 0.0 if last else CHANGE
        if any(abs(bits - self._listed[name]) > share * self._listed[name] for name, bits in known.items()):
            self._listed |= known
            self._write()

    def _write(self) -> None:
        listed = [ListedQuality(name, f"{name}/{MANIFEST}", round(bits)) for name, bits in self._listed.items()]
        write_list(self._folder, listed)


def expected_bits(quality: Quality) -> float:
    """Estimated bits per second of a quality before any measurement; only the order of qualities is reliable."""
    return EXPECTED_BITS * 2.0**quality.fineness


def bits_per_second(packets: Sequence[tuple[float, int]]) -> float | None:
    """Bits per second of media, at least 1, from times and sizes of packets; None if they have the same time.

    The first packet only marks the start time; its bytes do not count, because frame 0's packet is nearly empty.
    """
    seconds = packets[-1][0] - packets[0][0]
    return max(8 * sum(size for _, size in [*packets][1:]) / seconds, 1.0) if seconds > 0 else None


def listed_bits(folder: Path) -> Mapping[str, float]:
    """Bit rates of the list in a folder, by name; empty if there is no readable list."""
    try:
        return {quality.name: quality.bits_per_second for quality in read_list(folder) or ()}
    except StreamError:
        return {}
