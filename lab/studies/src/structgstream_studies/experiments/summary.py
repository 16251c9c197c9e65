# SPDX-License-Identifier: Apache-2.0
"""Results over seeds: means, spreads, and differences to the full method seed by seed.

Note [Paired differences]
~~~~~~~~~~~~~~~~~~~~~~~~~
Frame 0 varies more between seeds than variants differ, but variants of one seed share frame 0. So a variant is compared
with the full method seed by seed, and the differences are averaged.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from structgstream_studies.experiments.results import Result

STANDARD_ERRORS: Mapping[int, float] = {3: 4.303, 4: 3.182, 5: 2.776}
"""By the number of seeds: a difference is established if it is this many standard errors from zero (Student's t test of
paired differences, two-sided, 5 %). With more than five seeds the value of five is used, with fewer than three none."""
UNDECIDED = "cannot be decided"


@dataclass(frozen=True)
class Spread:
    """A mean over seeds with its sample standard deviation (0 for a single one)."""

    mean: float
    deviation: float
    count: int

    @property
    def standard_error(self) -> float:
        """Of the mean."""
        return self.deviation / math.sqrt(self.count)


def spread_of(values: Sequence[float]) -> Spread | None:
    """Mean and spread; None of nothing."""
    if not values:
        return None
    mean = sum(values) / len(values)
    squares = sum((value - mean) ** 2 for value in values)
    return Spread(mean, math.sqrt(squares / (len(values) - 1)) if len(values) > 1 else 0.0, len(values))


@dataclass(frozen=True)
class Summary:
    """Results of one method on one capture.

    Args:
        key: the variant or method.
        results: by seed.
    """

    key: str
    results: Mapping[int, Result]

    def score(self, name: str) -> Spread | None:
        """Mean and spread of a score's mean over each stream; None where no result has it."""
        return spread_of([value for result in self.results.values() if (value := score_of(result, name)) is not None])

    def difference(self, other: "Summary", name: str) -> Spread | None:
        """Mean and spread of this method's score minus ``other``'s, over the seeds that both have."""
        found = []
        for seed in sorted(self.results.keys() & other.results.keys()):
            ours, theirs = score_of(self.results[seed], name), score_of(other.results[seed], name)
            if ours is not None and theirs is not None:
                found.append(ours - theirs)
        return spread_of(found)

    def curve(self, name: str) -> list[Spread | None]:
        """A score for each frame: mean and spread over seeds."""
        frames = min(len(result.frames) for result in self.results.values())
        values = [[result.frames[i].get(name) for result in self.results.values()] for i in range(frames)]
        return [spread_of([value for value in row if value is not None]) for row in values]


def score_of(result: Result, name: str) -> float | None:
    """A score of a result by its name: a mean over the stream, a fact of the file, or what follows from its facts."""
    value: Any = result.mean.get(name, result.stream.get(name))
    if value is None and name == "bytes_with_header" and result.stream.get("total_bytes"):
        value = result.stream["total_bytes"] / len(result.frames)  # Results from before the score was written down.
    return None if value is None or isinstance(value, str | Mapping) else float(value)


def summaries(results: Iterable[Result]) -> dict[str, Summary]:
    """By key; the results must be of one capture and of one question each."""
    grouped: dict[str, dict[int, Result]] = {}
    for result in results:
        grouped.setdefault(result.key, {})[result.seed] = result
    return {key: Summary(key, dict(sorted(by_seed.items()))) for key, by_seed in grouped.items()}


def verdict(variant: Summary, full: Summary, name: str, *, expected_sign: float) -> str:
    """What three seeds say of a claim that ``variant`` minus ``full`` has ``expected_sign``."""
    difference = variant.difference(full, name)
    if difference is None or difference.count < min(STANDARD_ERRORS):
        return UNDECIDED
    needed = STANDARD_ERRORS[min(difference.count, max(STANDARD_ERRORS))]
    if abs(difference.mean) <= needed * difference.standard_error:
        return UNDECIDED
    return "reproduced" if difference.mean * expected_sign > 0 else "refuted"
