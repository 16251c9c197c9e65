# SPDX-License-Identifier: Apache-2.0
"""Whether lags of pairs close loops of three cameras, which wrong ones do only by chance."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

CLOSING_SECONDS = 3e-4  # by which the lags of a loop may miss each other
DOUBT = 1 / 3  # that a closed loop leaves: its lags, if wrong, would be spread over several milliseconds
MOST_LOOPS = 3


@dataclass(frozen=True)
class PairLag:
    """What is known of the clocks of two cameras.

    Args:
        first: name of a camera.
        second: name of another.
        instants: seconds by the first camera's clock, and the lag there: the second camera's second minus that.
        sigma_seconds: standard error of each lag.
        ambiguity_seconds: standard error that all of them share, because another peak may be the right one.
        confidence: how distinct it is.
        fine: whether phases tell the lag, so that loops close.
    """

    first: str
    second: str
    instants: tuple[tuple[float, float], ...]
    sigma_seconds: float
    ambiguity_seconds: float
    confidence: float
    fine: bool = True

    def at(self, seconds: float) -> float:
        """The second camera's second at a second of the first camera's, by a line through the lags."""
        times, lags = np.array(self.instants).T
        spread = times - times.mean()
        slope = float(spread @ lags / (spread @ spread)) if np.ptp(times) > 0 else 0.0
        return seconds + float(lags.mean()) + slope * (seconds - float(times.mean()))

    @property
    def middle(self) -> float:
        """The mean of the instants by the first camera's clock."""
        return float(np.mean([at for at, _ in self.instants]))


def doubts(lags: Sequence[PairLag]) -> list[float]:
    """For each pair the share of its ambiguity that closed loops leave, 1 where there is none.

    Loops that share a pair support each other, so their number is that of all that hang together.
    """
    known = {(lag.first, lag.second): lag for lag in lags if lag.fine}
    names = list(dict.fromkeys(name for pair in known for name in pair))
    groups: list[tuple[set[tuple[str, str]], int]] = []
    for three in combinations(names, 3):
        sides = [(a, b) if (a, b) in known else (b, a) for a, b in combinations(three, 2)]
        if any(side not in known for side in sides) or not _closes(three, known):
            continue
        joined, count = set(sides), 1
        for group in [group for group in groups if group[0] & joined]:
            groups.remove(group)
            joined, count = joined | group[0], count + group[1]
        groups.append((joined, count))
    loops = {pair: count for pairs, count in groups for pair in pairs}
    return [DOUBT ** min(loops.get((lag.first, lag.second), 0), MOST_LOOPS) for lag in lags]


def _closes(three: Sequence[str], known: dict[tuple[str, str], PairLag]) -> bool:
    """Whether the same instant by the third camera comes out by both ways."""
    a, b, c = three
    start = next(lag.middle for pair, lag in known.items() if set(pair) == {a, b})
    start = start if (a, b) in known else known[b, a].at(start)
    return abs(_told(known, b, c, _told(known, a, b, start)) - _told(known, a, c, start)) < CLOSING_SECONDS


def _told(known: dict[tuple[str, str], PairLag], first: str, second: str, seconds: float) -> float:
    if (first, second) in known:
        return known[first, second].at(seconds)
    lag = known[second, first]
    near = 2 * seconds - lag.at(seconds)
    return near + seconds - lag.at(near)
