# SPDX-License-Identifier: Apache-2.0
"""A folder of segments that is copied to another store in the background, such as an object store.

The folder is what counts: a packet is written when it is durable there, and whoever writes never waits for the network.
A thread copies what is new, with back-off when the other store cannot be reached; what waits is in the folder, also
after the process was killed, and the next run copies it. Only names are in memory.

Note [Order of copying]
~~~~~~~~~~~~~~~~~~~~~~~
One round takes the folder's manifest and those of the waiting files that it names together, copies the files, and then
the manifest, so that the other store's manifest names only files that are there. Manifests that were replaced meanwhile
are left out, and so is what only they named: the parts of a group that is a segment by now. So a store that is slower
than the stream, or was out of reach, is behind by about a round, however many frames came meanwhile. A file that is to
leave the folder during a round, which may take longer than the time of grace, leaves it when the round is over. A file
is removed from the other store no sooner than the time of grace after its first manifest without it, and a round
removes few more than it copies.

A store that has failed is compared with the folder before the next round: it may have lost what it had.
"""

import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass

from structgstream.codec.segments.manifest import MANIFEST, manifest_from_json
from structgstream.codec.segments.recovery import stale_files
from structgstream.codec.segments.store import FolderStore, Store
from structgstream.errors import StorageError, StreamError
from structgstream.owned_folders import MARKER, Owner, parse_owner

PURPOSE = "published copy of a stream"
_FIRST_WAIT_SECONDS = 0.5
_LONGEST_WAIT_SECONDS = 30.0
_MORE_REMOVED = 8
"""A round removes at most this many files more than it copies, so that removing the files of an earlier run does not
delay the copying of a live one."""


class AnotherStreamError(StorageError):
    """The other store holds files that this folder did not send."""


@dataclass(frozen=True)
class MirrorOptions:
    """How the copy is made."""

    grace_seconds: float = 120.0  # how long a file that has left the folder stays in the other store
    report: Callable[[str], object] = lambda text: None  # gets a sentence when trouble begins and when it ends
    elapsed: Callable[[], float] = time.monotonic  # seconds that never jump


class MirroredStore:
    """A folder whose files are copied to ``remote`` by a thread (Note [Order of copying])."""

    def __init__(self, folder: FolderStore, remote: Store, *, options: MirrorOptions | None = None) -> None:
        self._folder = folder
        self._remote = remote
        self._options = options or MirrorOptions()
        self._changed = threading.Condition()
        self._waiting: dict[str, None] = {}  # what the remote has not got, in the order of writing
        self._manifest_waits = False
        self._round_names: frozenset[str] = frozenset()  # what the round that goes on copies
        self._held: list[str] = []  # of them, what leaves the folder when it is over
        self._gone: dict[str, float | None] = {}  # names to remove, and since when the remote manifest lacks them
        self._ending = False
        self._claimed = False
        self._known = False  # whether the remote's files have been compared with the folder's
        self._busy = False
        self._failures = 0
        self._thread: threading.Thread | None = None

    @property
    def name(self) -> str:
        """The folder."""
        return self._folder.name

    def put(self, name: str, data: bytes) -> None:
        """Write to the folder; the copy follows when a manifest names it."""
        with self._changed:
            if name in self._held:
                self._held.remove(name)
        self._folder.put(name, data)
        with self._changed:
            if name != MANIFEST:
                self._waiting[name] = None
                self._gone.pop(name, None)
                return
            self._begin_round()

    def get(self, name: str, *, max_bytes: int | None = None) -> bytes:
        """From the folder."""
        return self._folder.get(name, max_bytes=max_bytes)

    def delete(self, name: str) -> None:
        """Remove from the folder, when it is not being copied; the copy goes later; a manifest's stays."""
        with self._changed:
            if name in self._round_names:
                self._held.append(name)
            else:
                self._remove(name)

    def _remove(self, name: str) -> None:
        """While nothing else changes."""
        self._folder.delete(name)
        if name == MANIFEST:
            self._manifest_waits = False
            return
        waited = name in self._waiting
        self._waiting.pop(name, None)
        if not (waited and self._known):  # A store that has failed may have it nevertheless.
            self._gone[name] = None

    def names(self) -> frozenset[str]:
        """Of the folder."""
        return self._folder.names()

    def free_bytes(self) -> int | None:
        """Of the folder."""
        return self._folder.free_bytes()

    def claim(self) -> None:
        """Mark the other store as this folder's copy (``owned_folders``, Note [Ownership]).

        Raises:
            AnotherStreamError: it holds files and another marker, or none; nothing in it was changed.
            StorageError, StreamError: it cannot be reached.
        """
        there, mine = self._remote.names(), _owner(self._folder)
        if mine is None:
            mine = Owner.new(PURPOSE)
            self._folder.put(MARKER, mine.content)
        theirs = _owner(self._remote)
        # A copy by another program has no marker; it is known by the stream's first record, whose name is its hash.
        sent = any(name.startswith("init-") for name in there & self._folder.names())
        if (theirs is None and there and not sent) or (theirs is not None and theirs.identity != mine.identity):
            raise AnotherStreamError(
                f"{self._remote.name} holds a stream that {self._folder.name} did not send, so it may be somebody "
                "else's; nothing in it was changed. Publish to another folder, or move that stream to another place."
            )
        if theirs is None:
            self._remote.put(MARKER, mine.content)
        self._claimed = True

    def copy_all(self) -> None:
        """Copy what an earlier run has left, if there is anything, also if nothing is written now."""
        if MANIFEST not in self._folder.names():
            return
        with self._changed:
            self._begin_round()

    def finish(self, *, wait_seconds: float) -> int:
        """Wait until everything is copied, at most this long, and end the thread.

        Returns:
            how many files still wait; they are in the folder, and the next run with the same folder copies them.
        """
        with self._changed:
            finished = self._changed.wait_for(lambda: not self._pending(), timeout=wait_seconds)
            self._ending = True
            self._changed.notify_all()
            left = 0
            if not finished:
                with suppress(StreamError):  # A stream that was to be replaced has no manifest yet.
                    left = len(self._due()[0]) + 1
            thread = self._thread
        if thread is not None and finished:
            thread.join()
        return left

    def _pending(self) -> bool:
        return self._thread is not None and (self._manifest_waits or self._busy)

    def _due(self) -> tuple[list[str], bytes]:
        """Those of the files that wait that the folder's manifest names, and the manifest."""
        manifest = self._folder.get(MANIFEST)
        named = manifest_from_json(manifest, name=f"{MANIFEST} in {self._folder.name}")
        stale = stale_files(named, frozenset(self._waiting))
        return [name for name in self._waiting if name not in stale], manifest

    def _begin_round(self) -> None:
        """While nothing else changes."""
        self._manifest_waits = True
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="segments-mirror", daemon=True)
            self._thread.start()
        self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ending or self._manifest_waits)
                if self._ending:
                    return
                self._busy = True
            wait_seconds = self._round()
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                if wait_seconds:
                    self._changed.wait_for(lambda: self._ending, timeout=wait_seconds)

    def _round(self) -> float:
        """Copy what waits; returns the seconds to wait before the next round."""
        try:
            if not self._known:
                self._compare()
            self._copy()
        except (StorageError, StreamError) as error:
            self._failures += 1
            self._known = False
            if isinstance(error, AnotherStreamError):
                if self._failures == 1:
                    self._options.report(f"{error} The stream goes on in {self._folder.name}.")
            elif self._failures == 2:  # A single failure is not reported.
                self._options.report(
                    f"{self._remote.name} cannot be reached ({error}); the stream goes on in {self._folder.name}, and "
                    "is copied when it can be again."
                )
            return min(_FIRST_WAIT_SECONDS * 2.0 ** (self._failures - 1), _LONGEST_WAIT_SECONDS)
        if self._failures >= 2:
            self._options.report(f"{self._remote.name} can be reached again, and is up to date.")
        self._failures = 0
        return 0.0

    def _compare(self) -> None:
        """Find what the remote has not got, and what is there and no longer here."""
        if not self._claimed:
            self.claim()
        there = self._remote.names()
        with self._changed:
            here = self._folder.names()
            earlier = {name: None for name in sorted(here - self._waiting.keys()) if name != MANIFEST}
            self._waiting = {name: None for name in (*earlier, *self._waiting) if name not in there}
            left = dict.fromkeys(sorted(there - here - {MANIFEST}))
            self._gone = {name: since for name, since in {**left, **self._gone}.items() if name in there}
            self._manifest_waits = MANIFEST in here
            self._known = True

    def _copy(self) -> None:
        """One round."""
        with self._changed:
            if not self._manifest_waits:
                return  # The stream is being replaced.
            names, manifest = self._due()
            self._manifest_waits = False
            self._round_names = frozenset(names)
            leaving = [name for name, since in self._gone.items() if since is None]
        try:
            for name in names:
                self._remote.put(name, self._folder.get(name))
                with self._changed:
                    self._waiting.pop(name, None)
            self._remote.put(MANIFEST, manifest)
        except BaseException:
            with self._changed:
                self._manifest_waits, self._known = True, False
            raise
        finally:
            with self._changed:
                self._round_names = frozenset()
                held, self._held = self._held, []
                for name in held:
                    with suppress(StorageError):  # It is found again when the stream is resumed.
                        self._remove(name)
        self._clean(leaving, most=len(names) + _MORE_REMOVED)

    def _clean(self, leaving: Iterable[str], *, most: int) -> None:
        """Remove from the remote what its manifests have not named for the time of grace; ``leaving`` from now on."""
        now = self._options.elapsed()
        late = now - self._options.grace_seconds
        with self._changed:
            self._gone.update({name: now for name in leaving if name in self._gone})
            removed = [name for name, since in self._gone.items() if since is not None and since <= late]
        for name in removed[:most]:
            self._remote.delete(name)
            with self._changed:
                self._gone.pop(name, None)


def _owner(store: Store) -> Owner | None:
    """As the marker of a store has it; None if there is none."""
    try:
        return parse_owner(store.get(MARKER, max_bytes=4096))
    except StreamError:
        return None
