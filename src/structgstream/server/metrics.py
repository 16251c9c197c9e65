# SPDX-License-Identifier: Apache-2.0
"""What a server counts, and the text in which Prometheus reads it (exposition format 0.0.4)."""

import json
import math
import re
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

VIEWER_SECONDS: Final = 30.0
MOST_VIEWERS: Final = 10_000
MOST_RUN_NUMBERS: Final = 500
CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

Labels = Mapping[str, str]


@dataclass(frozen=True)
class Family:
    """Numbers of one name.

    Args:
        name: of the metric.
        kind: ``counter`` or ``gauge``.
        help: what it is, in a line.
        samples: labels and number of each.
    """

    name: str
    kind: str
    help: str
    samples: Iterable[tuple[Labels, float]]


class Viewers:
    """Who asked for a stream in the last half minute: connections, or addresses where a proxy holds the connections."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: OrderedDict[tuple[str, object], float] = OrderedDict()

    def see(self, stream: str, client: object) -> None:
        """Someone asked."""
        self._seen[stream, client] = self._clock()
        self._seen.move_to_end((stream, client))
        while len(self._seen) > MOST_VIEWERS:
            self._seen.popitem(last=False)

    def counts(self) -> Counter[str]:
        """How many, by stream."""
        while self._seen and next(iter(self._seen.values())) < self._clock() - VIEWER_SECONDS:
            self._seen.popitem(last=False)
        return Counter(stream for stream, _ in self._seen)


class Metrics:
    """Counters of one server.

    Attributes:
        requests: answers by stream, kind and status.
        sent_bytes: bytes of bodies by stream.
        refused: connections and requests that were refused, by reason.
        viewers: who watches.
    """

    def __init__(self) -> None:
        self.requests: Counter[tuple[str, str, int]] = Counter()
        self.sent_bytes: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.viewers = Viewers()

    def families(self) -> list[Family]:
        """The counters."""
        requests = [
            ({"stream": stream, "kind": kind, "status": str(status)}, float(count))
            for (stream, kind, status), count in sorted(self.requests.items())
        ]
        return [
            Family("structgstream_requests_total", "counter", "Answers.", requests),
            Family("structgstream_sent_bytes_total", "counter", "Bytes of answers.", by("stream", self.sent_bytes)),
            Family("structgstream_refused_total", "counter", "Refused requests.", by("reason", self.refused)),
            Family("structgstream_viewers", "gauge", "Who asked lately.", by("stream", self.viewers.counts())),
        ]


def by(label: str, numbers: Mapping[str, float]) -> list[tuple[Labels, float]]:
    """Samples with one label, sorted."""
    return [({label: name}, float(number)) for name, number in sorted(numbers.items())]


def exposition(families: Iterable[Family]) -> str:
    """The families as text."""
    return "".join(line for family in families for line in _lines(family))


def _lines(family: Family) -> Iterator[str]:
    yield f"# HELP {family.name} {family.help}\n# TYPE {family.name} {family.kind}\n"
    for labels, number in family.samples:
        inside = ",".join(f'{name}="{_escaped(text)}"' for name, text in labels.items())
        yield f"{family.name}{{{inside}}} {_number(number)}\n" if inside else f"{family.name} {_number(number)}\n"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _number(number: float) -> str:
    if math.isnan(number):
        return "NaN"
    if math.isinf(number):
        return "+Inf" if number > 0 else "-Inf"
    return str(int(number)) if number == int(number) and abs(number) < 2**53 else repr(number)


def run_numbers(content: bytes) -> dict[str, float]:
    """The numbers in a trainer's ``OUT.metrics.json`` by the path to them, joined by ``_``: at most 500 of them.

    Lists and texts are left out. What is no JSON object has none: a run that writes it may be of another version.
    """
    try:
        values = json.loads(content)
    except (ValueError, RecursionError):
        return {}
    found: dict[str, float] = {}
    _collect(values, "", found)
    return found


def _collect(values: Any, path: str, found: dict[str, float]) -> None:
    if isinstance(values, dict):
        for key, value in values.items():
            _collect(value, f"{path}_{_word(str(key))}" if path else _word(str(key)), found)
    elif isinstance(values, (int, float)) and path and len(found) < MOST_RUN_NUMBERS and abs(values) < 2**63:
        found[path] = float(values)


def _word(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()[:64]).strip("_") or "unnamed"
