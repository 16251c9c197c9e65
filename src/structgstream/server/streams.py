# SPDX-License-Identifier: Apache-2.0
"""The streams of a running server: their manifests, previews and cached files, and what is told about them."""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from anyio import to_thread

from structgstream.codec.container.records import footer_offset
from structgstream.server.catalog import Catalog, ServedStream, StreamKind
from structgstream.server.file_cache import FileCache
from structgstream.server.manifest_watch import BrokenManifest, ManifestWatch, Snapshot
from structgstream.server.metrics import Family, by, run_numbers
from structgstream.server.names import MANIFEST
from structgstream.server.pages import Listed
from structgstream.server.previews import Picture, Previews, Render

MOST_RUN_BYTES = 256 * 1024
MOST_WATCHES = 1000


class Streams:
    """What the routes ask for. Nothing of it blocks the loop.

    Args:
        catalog: which streams there are.
        render: makes previews; None shows only those that are files.
        clock: Unix seconds.
    """

    def __init__(self, catalog: Catalog, *, render: Render | None, clock: Callable[[], float] = time.time) -> None:
        self._catalog = catalog
        self._clock = clock
        self._watches: dict[str, ManifestWatch] = {}
        self._previews = Previews(render)
        self.files = FileCache()

    async def named(self, name: str) -> ServedStream | None:
        """The stream of this name, or None."""
        return (await self._found()).get(name)

    async def all(self) -> list[ServedStream]:
        """All of them, sorted by their names."""
        return list((await self._found()).values())

    async def _found(self) -> Mapping[str, ServedStream]:
        if self._catalog.stale:
            await to_thread.run_sync(self._catalog.look)
        return self._catalog.found

    def watch(self, stream: ServedStream) -> ManifestWatch:
        """The one watcher of a stream of segments."""
        if stream.name not in self._watches:
            idle = next((name for name, watch in self._watches.items() if not watch.waiters), None)
            if idle is not None and len(self._watches) >= MOST_WATCHES:
                del self._watches[idle]
            self._watches[stream.name] = ManifestWatch(lambda: stream.open(MANIFEST))
        return self._watches[stream.name]

    @property
    def waiters(self) -> int:
        """How many requests wait for a newer manifest."""
        return sum(watch.waiters for watch in self._watches.values())

    async def manifest(self, stream: ServedStream) -> Snapshot | None:
        """The manifest of a stream of segments; None of another stream, or where there is none or a broken one."""
        if stream.kind is not StreamKind.SEGMENTS:
            return None
        try:
            return await self.watch(stream).current()
        except BrokenManifest:
            return None

    async def preview(self, stream: ServedStream) -> Picture | None:
        """The preview picture, of several qualities that of the finest; None if there is none, or none yet."""
        if stream.kind is StreamKind.QUALITIES:
            return await self.preview(stream.made_of[-1])
        if stream.kind is StreamKind.FILE:
            key = await to_thread.run_sync(_file_key, stream)
        else:
            found = await self.manifest(stream)
            key = None if found is None else _newest_key(found.values)
        return None if key is None else await self._previews.picture(stream, key)

    async def listed(self, stream: ServedStream) -> Listed:
        """What the list says of a stream."""
        found = await self.manifest(stream.made_of[0]) if stream.made_of else None
        live, seconds = (None, None) if found is None else (found.live, _number(found.values, "edge", "pts_seconds"))
        return Listed(stream.name, stream.kind.value, live, seconds)

    async def families(self) -> list[Family]:
        """Gauges of all streams, and the numbers of the runs that make them."""
        streams = await self.all()
        each = [own for stream in streams for own in stream.made_of]
        found = {own.name: snapshot for own in each if (snapshot := await self.manifest(own))}
        published = {name: _number(one.values, "edge", "published_unix_seconds") for name, one in found.items()}
        frames = {name: _number(one.values, "edge", "frame") for name, one in found.items()}
        waiting = {name: float(watch.waiters) for name, watch in self._watches.items()}
        cached = [({}, float(self.files.cached_bytes))]
        runs = [entry for stream in streams for entry in await to_thread.run_sync(_run_samples, stream)]
        ages = {name: self._clock() - then for name, then in published.items() if then is not None}
        known = {name: frame for name, frame in frames.items() if frame is not None}
        sequences = {name: float(one.sequence) for name, one in found.items()}
        live = {name: float(one.live) for name, one in found.items()}
        return [
            Family("structgstream_waiters", "gauge", "Requests that wait for a manifest.", by("stream", waiting)),
            Family("structgstream_live", "gauge", "1 while the stream is made.", by("stream", live)),
            Family("structgstream_manifest_sequence", "gauge", "Of the manifest.", by("stream", sequences)),
            Family("structgstream_edge_frame", "gauge", "Number of the newest frame.", by("stream", known)),
            Family("structgstream_edge_age_seconds", "gauge", "Since the newest frame.", by("stream", ages)),
            Family("structgstream_cached_bytes", "gauge", "Bytes of files in memory.", cached),
            Family("structgstream_run", "gauge", "Numbers of the run that makes the stream.", runs),
        ]


def _run_samples(stream: ServedStream) -> list[tuple[dict[str, str], float]]:
    opened = stream.open_beside(".metrics.json")
    if opened is None:
        return []
    with opened:
        content = opened.read(0, min(len(opened), MOST_RUN_BYTES))
    return [({"stream": stream.name, "name": name}, number) for name, number in run_numbers(content).items()]


def _file_key(stream: ServedStream) -> str | None:
    """What changes when a growing file's first frame, or a finished file, can be shown; None if it is gone."""
    opened = stream.open_whole()
    if opened is None:
        return None
    with opened as data:
        return f"{data.stamp.inode}-{data.stamp.modified_ns if footer_offset(data) is not None else 'growing'}"


def _newest_key(values: dict[str, Any]) -> str:
    """What changes with the newest key frame of a manifest, whose values nobody has checked."""
    entries = [entry for name in ("parts", "segments") for entry in _items(values.get(name))]
    return next((str(entry.get("file")) for entry in entries if entry.get("kind", "key") == "key"), "")


def _items(value: Any) -> Iterator[dict[str, Any]]:
    """The objects of a list, the newest first where it is of segments."""
    if isinstance(value, list):
        yield from (entry for entry in reversed(value) if isinstance(entry, dict))


def _number(values: dict[str, Any], group: str, name: str) -> float | None:
    inner = values.get(group)
    found = inner.get(name) if isinstance(inner, dict) else None
    if isinstance(found, bool) or not isinstance(found, int | float) or not abs(found) < 2**63:
        return None
    return float(found)
