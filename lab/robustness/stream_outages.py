# SPDX-License-Identifier: Apache-2.0
"""Disks that fill up and object stores that go out of reach, for ``kills``."""

import random
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from lab.robustness.stream_writers import OPTIONS, Row, Sent, content, edge_of, readable, send
from structgstream.codec.segments.mirror import MirroredStore
from structgstream.codec.segments.store import FolderStore, Store
from structgstream.codec.sinks import resume_segments
from structgstream.errors import StorageError

DISK_BYTES = 3_000_000


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A disk of :data:`DISK_BYTES` (tmpfs, for which this must be root).

    Raises:
        PermissionError: nothing can be mounted here.
    """
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "none", str(folder)]
    mounted = subprocess.run(command, capture_output=True, check=False)
    if mounted.returncode:
        raise PermissionError(mounted.stderr.decode())
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)
        folder.rmdir()


class Blind(FolderStore):
    """A folder whose disk does not say how full it is."""

    def free_bytes(self) -> int | None:
        """Not known."""
        return None


@dataclass
class Neighbour:
    """Fills a disk but for ``left`` bytes when frame ``at`` is reported."""

    disk: Path
    at: int
    left: int
    seen: list[int] = field(default_factory=list)

    def report(self, frame: int) -> None:
        """Note the frame."""
        self.seen.append(frame)
        if frame == self.at:
            with suppress(OSError):
                (self.disk / "neighbour").write_bytes(bytes(max(shutil.disk_usage(self.disk).free - self.left, 0)))

    def leave(self) -> None:
        """Make room again."""
        (self.disk / "neighbour").unlink(missing_ok=True)


def full_disks(row: Row, sent: Sent, *, count: int, folder: Path, seed: int, margin: bool) -> Row:
    """A small disk is filled by a neighbour at a random frame, and has room again later.

    With ``margin`` the sink sees it come and closes the stream; without, it knows nothing, and writes fail.
    """
    rng = random.Random(seed)
    for number in range(count):
        row.streams, row.events = row.streams + 1, row.events + 1
        at, left = rng.randrange(1, len(sent.packets) - 1), rng.randrange(0, 200_000 if margin else 9_000)
        with small_disk(folder / f"disk{number}") as disk:
            store = FolderStore(disk / "out") if margin else Blind(disk / "out")
            store.prepare()
            neighbour = Neighbour(disk, at, left)
            failed = not _went_on(store, sent, neighbour)
            row.reported_frames_lost += max(max(neighbour.seen) - edge_of(store.folder), 0)
            row.reads_refused += not readable(store.folder, sent.whole)
            neighbour.leave()
            begun = time.monotonic()
            if failed:
                neighbour.at = -1
                _went_on(store, sent, neighbour)
                row.seconds_until_normal.append(time.monotonic() - begun)
            row.equal += content(store.folder, beside=folder) == sent.whole
    return row


def _went_on(store: Store, sent: Sent, neighbour: Neighbour) -> bool:
    """Go on with a stream as a session does: after an error the sink is closed, and what that says is left out."""
    sink, resumed = resume_segments(store, options=OPTIONS)
    try:
        send(sink, sent, 0 if resumed is None else len(resumed), neighbour.report)
    except StorageError:
        with suppress(StorageError):
            sink.close()
        return False
    return True


class Unreachable(FolderStore):
    """A folder that stands for an object store, which can be out of reach."""

    reachable = True

    def put(self, name: str, data: bytes) -> None:
        """Write, unless it is out of reach."""
        if not self.reachable:
            raise StorageError("no route to host")
        super().put(name, data)


@dataclass
class Cut:
    """Cuts the connection when frame ``at`` is reported."""

    remote: Unreachable
    at: int
    seen: int = 0

    def report(self, frame: int) -> None:
        """Note the frame."""
        self.seen += 1
        if frame == self.at:
            self.remote.reachable = False


def outages(row: Row, sent: Sent, *, count: int, seconds: float, folder: Path, seed: int) -> Row:
    """The target of ``--publish`` cannot be reached from a random frame on, for ``seconds``."""
    rng = random.Random(seed)
    for number in range(count):
        row.streams, row.events = row.streams + 1, row.events + 1
        here, remote = FolderStore(folder / f"here{number}"), Unreachable(folder / f"there{number}")
        here.prepare()
        remote.prepare()
        mirror = MirroredStore(here, remote)
        cut = Cut(remote, rng.randrange(1, len(sent.packets) - 1))
        sink, _ = resume_segments(mirror, options=OPTIONS)
        send(sink, sent, 0, cut.report)
        row.reported_frames_lost += len(sent.packets) - cut.seen
        row.reads_refused += (remote.folder / "manifest.json").exists() and not readable(remote.folder, sent.whole)
        time.sleep(seconds)
        remote.reachable, begun = True, time.monotonic()
        left = mirror.finish(wait_seconds=120.0)
        row.seconds_until_normal.append(time.monotonic() - begun)
        row.equal += not left and content(remote.folder, beside=folder) == sent.whole
    return row
