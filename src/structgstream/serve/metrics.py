# SPDX-License-Identifier: Apache-2.0
"""Metrics of a server, for Prometheus."""

import json
import re
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from types import SimpleNamespace
from typing import Any, Final

from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from structgstream.serve.manifest_watch import Snapshot

VIEWER_SECONDS: Final = 30.0
MAX_VIEWERS: Final = 10_000
MAX_RUN_NUMBERS: Final = 500


class Viewers:
    """The clients of each stream in the last half minute: connections, or addresses behind a proxy."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: OrderedDict[tuple[str, object], float] = OrderedDict()

    def see(self, stream: str, client: object) -> None:
        """Record a request."""
        self._seen[stream, client] = self._clock()
        self._seen.move_to_end((stream, client))
        while len(self._seen) > MAX_VIEWERS:
            self._seen.popitem(last=False)

    def counts(self) -> Counter[str]:
        """Number of viewers by stream."""
        while self._seen and next(iter(self._seen.values())) < self._clock() - VIEWER_SECONDS:
            self._seen.popitem(last=False)
        return Counter(stream for stream, _ in self._seen)


class Metrics:
    """Counters of one server."""

    def __init__(self) -> None:
        self.requests: Counter[tuple[str, str, int]] = Counter()  # responses by stream, kind and status
        self.sent_bytes: Counter[str] = Counter()  # of response bodies, by stream
        self.in_progress = 0  # requests that are being answered
        self.viewers = Viewers()

    def families(self) -> list[Metric]:
        """The counters as Prometheus metric families."""
        requests = CounterMetricFamily("structgstream_requests", "Responses.", labels=("stream", "kind", "status"))
        for (stream, kind, status), count in sorted(self.requests.items()):
            requests.add_metric((stream, kind, str(status)), count)
        sent = CounterMetricFamily("structgstream_sent_bytes", "Bytes of response bodies.", labels=("stream",))
        for stream, count in sorted(self.sent_bytes.items()):
            sent.add_metric((stream,), count)
        return [
            requests,
            sent,
            GaugeMetricFamily("structgstream_requests_in_progress", "Being answered.", value=self.in_progress),
            by_stream("viewers", "Clients of the last 30 seconds.", self.viewers.counts()),
        ]


class CountRequests:
    """ASGI middleware that counts responses; routes set ``scope["counted_as"] = (stream, kind)``."""

    def __init__(self, app: ASGIApp, *, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        status, sent = 500, 0

        async def counted(message: Message) -> None:
            nonlocal status, sent
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)
            sent += 0 if scope["method"] == "HEAD" else len(message.get("body", b""))

        self._metrics.in_progress += 1
        try:
            await self._app(scope, receive, counted)
        finally:
            self._metrics.in_progress -= 1
            stream, kind = scope.get("counted_as", ("", "other"))
            self._metrics.requests[stream, kind, status] += 1
            self._metrics.sent_bytes[stream] += sent


def by_stream(name: str, documentation: str, numbers: Mapping[str, float | None]) -> Metric:
    """A gauge with a number for each stream that has one."""
    family = GaugeMetricFamily(f"structgstream_{name}", documentation, labels=("stream",))
    for stream, number in sorted(numbers.items()):
        if number is not None:
            family.add_metric((stream,), number)
    return family


def stream_families(
    manifests: Mapping[str, Snapshot],
    *,
    waiters: Mapping[str, int],
    runs: Mapping[str, Mapping[str, float]],
    unix_seconds: float,
) -> list[Metric]:
    """Gauges of streams and of the runs that write them."""
    published = {name: one.edge("published_unix_seconds") for name, one in manifests.items()}
    ages = {name: None if then is None else unix_seconds - then for name, then in published.items()}
    run = GaugeMetricFamily(
        "structgstream_run", "Numbers of the run that writes the stream.", labels=("stream", "name")
    )
    for stream, numbers in runs.items():
        for name, number in numbers.items():
            run.add_metric((stream, name), number)
    return [
        by_stream("waiters", "Requests that wait for a manifest.", waiters),
        by_stream("live", "1 while frames are added.", {name: one.live for name, one in manifests.items()}),
        by_stream("manifest_sequence", "Of the manifest.", {name: one.sequence for name, one in manifests.items()}),
        by_stream("edge_frame", "Newest frame.", {name: one.edge("frame") for name, one in manifests.items()}),
        by_stream("edge_age_seconds", "Since the newest frame was published.", ages),
        run,
    ]


def exposition(families: Iterable[Metric]) -> bytes:
    """The families in the text format of Prometheus."""
    return generate_latest(SimpleNamespace(collect=lambda: families))  # type: ignore[arg-type]


def run_numbers(content: bytes) -> dict[str, float]:
    """The numbers in a run's ``OUT.metrics.json`` by the path to them, joined by ``_``: at most 500.

    Lists and strings are skipped. The result is empty for content that is not a JSON object, because the run may be of
    another version.
    """
    try:
        values = json.loads(content)
        return dict(islice(_numbers(values), MAX_RUN_NUMBERS)) if isinstance(values, dict) else {}
    except (ValueError, RecursionError):
        return {}


def _numbers(values: Any, *path: str) -> Iterator[tuple[str, float]]:
    if isinstance(values, dict):
        for key, value in values.items():
            name = re.sub(r"[^a-z0-9]+", "_", str(key).lower()[:64]).strip("_") or "unnamed"
            yield from _numbers(value, *path, name)
    elif isinstance(values, (int, float)) and abs(values) < 2**63:
        yield "_".join(path), float(values)
