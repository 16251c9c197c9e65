# SPDX-License-Identifier: Apache-2.0
"""Streams of segments that several tests write, and stores that fail."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.segments.manifest import SegmentEntry, file_name, sha256_of
from structgstream.codec.segments.sink import Clocks, SegmentsOptions
from structgstream.codec.segments.store import FolderStore, Store
from structgstream.codec.sinks import MemorySink, resume_segments
from tests.support.streams import header_for, moved, small_scene

SHA256 = sha256_of(b"")
"""What entries of files state whose content does not matter."""


class Killed(BaseException):
    """What a test raises where a process would be killed."""


def header() -> StreamHeader:
    """The header of all streams here."""
    return header_for(moved(small_scene(), 0))


def packets(frames: int, *, group: int = 3) -> list[Packet]:
    """As many packets, one key packet in each group."""
    encoder = SceneEncoder(header())
    kinds = [PacketKind.DELTA if i % group else PacketKind.KEY for i in range(frames)]
    scenes = (moved(small_scene(), i % 7) for i in range(frames))
    return [
        encoder.encode(scene, index=i, pts_seconds=i / 30.0, kind=kinds[i]).packet for i, scene in enumerate(scenes)
    ]


def segment_entry(
    number: int, *, frames: int = 3, sizes: tuple[int, int] = (100, 10), fps: float = 30.0
) -> SegmentEntry:
    """A segment of as many frames as each before it, of these sizes of key and delta packets."""
    first, all_sizes = number * frames, (sizes[0], *[sizes[1]] * (frames - 1))
    name, seconds = file_name("segment", number, SHA256), (first / fps, (first + frames - 1) / fps)
    return SegmentEntry(number, name, 0, first, frames, seconds, sum(all_sizes), sizes[0], all_sizes, SHA256)


def as_file(sent: Sequence[Packet]) -> bytes:
    """The stream file of these packets."""
    sink = MemorySink()
    sink.open(header())
    for packet in sent:
        sink.write(packet)
    sink.close()
    return sink.data


@dataclass
class Hands:
    """Clocks that a test moves."""

    wall: float = 1.7e9
    elapsed: float = 0.0

    def clocks(self) -> Clocks:
        """As a sink takes them."""
        return Clocks(wall=lambda: self.wall, elapsed=lambda: self.elapsed)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self.wall += seconds
        self.elapsed += seconds


def written(
    store: Store,
    sent: Sequence[Packet],
    *,
    options: SegmentsOptions | None = None,
    hands: Hands | None = None,
    after: Callable[[int], object] = lambda frame: None,
    periods: Mapping[int, StreamHeader] | None = None,
) -> None:
    """Write a stream, or what is missing of one, as a session does; a second passes with every frame. ``periods`` are
    headers by first frame, if there are several."""
    hands, periods = hands or Hands(), periods or {0: header()}
    sink, resumed = resume_segments(store, options=options, clocks=hands.clocks())
    start = 0 if resumed is None else len(resumed)
    if resumed is not None and resumed.complete and start == len(sent):
        return
    sink.open(periods[0] if resumed is None else resumed.header_of(start - 1))
    for packet in sent[start:]:
        hands.wait(1.0)
        if packet.index and packet.index in periods:
            sink.begin(periods[packet.index])
        sink.write(packet)
        after(packet.index)
    sink.close()


def folder(path: Path) -> FolderStore:
    """A folder that is there."""
    store = FolderStore(path)
    store.prepare()
    return store


@dataclass
class KilledStore:
    """A store whose writer is killed at one of its operations: before it, or after it.

    Args:
        store: what is really written.
        at: number of the operation, or how it begins.
        done: whether that operation is still done.
    """

    store: FolderStore
    at: int | str
    done: bool
    operations: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """As the store's."""
        return self.store.name

    def put(self, name: str, data: bytes) -> None:
        """Write, unless it is the operation."""
        self._count(f"put {name}", lambda: self.store.put(name, data))

    def delete(self, name: str) -> None:
        """Remove, unless it is the operation."""
        self._count(f"delete {name}", lambda: self.store.delete(name))

    def get(self, name: str, *, max_bytes: int | None = None) -> bytes:
        """As the store's."""
        return self.store.get(name)

    def names(self) -> frozenset[str]:
        """As the store's."""
        return self.store.names()

    def free_bytes(self) -> int | None:
        """As the store's."""
        return self.store.free_bytes()

    def _count(self, what: str, do: Callable[[], None]) -> None:
        self.operations.append(what)
        killed = what.startswith(self.at) if isinstance(self.at, str) else len(self.operations) > self.at
        if not killed or self.done:
            do()
        if killed:
            (self.store.folder / ".new-manifest.json").write_bytes(b"half of it")
            raise Killed
