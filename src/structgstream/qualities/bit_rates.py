# SPDX-License-Identifier: Apache-2.0
"""The bit rates in the list of qualities: expected at the beginning, measured as soon as there are some packets."""

from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import ListedQuality, read_list, write_list
from structgstream.errors import StreamError
from structgstream.frame_report import FrameReport
from structgstream.qualities.ladder import Quality

EXPECTED_BITS = 2e6
"""Bits a second of quality 0, where nothing is known: 1.9 and 2.9 Mbit/s in lab/notes/compact-measured.md. One more
doubles it."""
LEAST_PACKETS = 5
MOST_PACKETS = 60
"""Packets over which a rate is taken: two groups of a second, or more where frames are left out."""
CHANGE = 0.1
"""The list is written anew when a rate is off by this share."""


class BitRates:
    """The list of qualities in a folder, kept up to date.

    Args:
        folder: holds the list, and a folder of segments for each quality.
        qualities: what it lists.
    """

    def __init__(self, folder: Path, qualities: Sequence[Quality]) -> None:
        self._folder = folder
        self._listed = {quality.name: expected_bits(quality) for quality in qualities}
        self._packets = {quality.name: deque[tuple[float, int]](maxlen=MOST_PACKETS + 1) for quality in qualities}

    def begin(self, *, resume: bool) -> None:
        """Writes the list, with the rates of an earlier run if that is resumed.

        Raises:
            StorageError: it cannot be written.
        """
        if resume:
            self._listed |= {name: bits for name, bits in listed_bits(self._folder).items() if name in self._listed}
        self._write()

    def add(self, name: str, report: FrameReport) -> None:
        """Takes a stored frame of a quality."""
        self._packets[name].append((report.pts_seconds, report.bytes))

    def refresh(self, *, last: bool = False) -> None:
        """Writes the list if a measured rate is another than the list says.

        Args:
            last: no frame follows, so that what was measured counts, however little it is.

        Raises:
            StorageError: it cannot be written; the list of before stays.
        """
        known = {
            name: bits
            for name, packets in self._packets.items()
            if len(packets) > (1 if last else LEAST_PACKETS) and (bits := bits_per_second(packets)) is not None
        }
        share = 0.0 if last else CHANGE
        if any(abs(bits - self._listed[name]) > share * self._listed[name] for name, bits in known.items()):
            self._listed |= known
            self._write()

    def _write(self) -> None:
        listed = [ListedQuality(name, f"{name}/{MANIFEST}", round(bits)) for name, bits in self._listed.items()]
        write_list(self._folder, listed)


def expected_bits(quality: Quality) -> float:
    """Bits a second that a quality may take before any is known; only their order is meant to be right."""
    return EXPECTED_BITS * 2.0**quality.fineness


def bits_per_second(packets: Sequence[tuple[float, int]]) -> float | None:
    """Bits a second of media, of packets with their times and bytes; at least 1, None where no time has passed.

    What the first one of them takes is left out, as the time before it is: frame 0's packet is nearly empty.
    """
    seconds = packets[-1][0] - packets[0][0]
    return max(8 * sum(size for _, size in [*packets][1:]) / seconds, 1.0) if seconds > 0 else None


def listed_bits(folder: Path) -> Mapping[str, float]:
    """What the list in a folder says, by name; empty without one that can be read."""
    try:
        return {quality.name: quality.bits_per_second for quality in read_list(folder) or ()}
    except StreamError:
        return {}
