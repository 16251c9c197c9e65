# SPDX-License-Identifier: Apache-2.0
"""The qualities of a run: names and fineness."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from structgstream.codec.segments.quality_list import MAX_QUALITIES, is_quality_name
from structgstream.errors import ConfigError
from structgstream.session.presets import MAX_QUALITY, StreamConfig, with_budget

_GIVEN = re.compile(r"([^=]*)=([^=]*)")


@dataclass(frozen=True)
class Quality:
    """One of the qualities.

    Args:
        name: name of its folder.
        fineness: ``online.rounding.quality``: 0 is the preset's own, 1 halves every quantization step.
    """

    name: str
    fineness: float


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
