# SPDX-License-Identifier: Apache-2.0
"""The qualities of a run: names and fineness."""

import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import (
    MAX_QUALITIES,
    ListedQuality,
    is_quality_name,
    read_list,
    write_list,
)
from structgstream.errors import ConfigError, StreamError
from structgstream.session.frame_report import FrameReport
from structgstream.session.presets import MAX_QUALITY, StreamConfig, with_budget

_GIVEN = re.compile(r"([^=]*)=([^=]*)")


@dataclass(frozen=True)
class Quality:
    """One of the qualities."""

    name: str  # name of its folder
    fineness: float  # online.rounding.quality: 0 is the preset's own, 1 halves every quantization step


def qualities_in(given: Sequence[str]) -> tuple[Quality, ...]:
    """The qualities of texts such as ``low=-1``, the coarsest first, which viewers load first.

    Raises:
        ConfigError: a text is malformed, two qualities have the same name or fineness, or their number is out of range.
    """
    qualities = sorted(map(_parsed, given), key=lambda quality: quality.fineness)
    if not 2 <= len(qualities) <= MAX_QUALITIES:
        raise ConfigError(
            f"--qualities takes 2 to {MAX_QUALITIES} qualities, which is what players choose from, got "
            f"{len(qualities)}; for a single one give --quality."
        )
    # Some file systems do not distinguish upper and lower case.
    for what, values in (("name", [q.name.lower() for q in qualities]), ("Q", [f"{q.fineness:g}" for q in qualities])):
        if twice := [one for one, other in pairwise(sorted(values)) if one == other]:
            raise ConfigError(
                f"--qualities has the {what} {twice[0]} twice; each quality needs a name and a Q of its own."
            )
    return tuple(qualities)


def configured(config: StreamConfig, quality: Quality) -> StreamConfig:
    """``config`` with a quality, as set by ``--quality``.

    Raises:
        ConfigError: the codec does not support qualities.
    """
    if config.codec != "compact":
        raise ConfigError(
            f"--qualities is for streams with the codec compact, got the codec {config.codec}; add --preset compact."
        )
    return with_budget(config, name=None, quality=quality.fineness, mbits=None)


def _parsed(text: str) -> Quality:
    match = _GIVEN.fullmatch(text)
    try:
        name, fineness = ("", float("nan")) if match is None else (match[1], float(match[2]))
    except ValueError:
        name, fineness = "", float("nan")
    if not is_quality_name(name) or not abs(fineness) <= MAX_QUALITY:
        raise ConfigError(
            f"--qualities {text} is no quality; expected NAME=Q, a name of letters, digits, '-' and '_' and a Q from "
            f"{-MAX_QUALITY:g} to {MAX_QUALITY:g}, such as low=-1 or high=1."
        )
    return Quality(name, fineness)


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
