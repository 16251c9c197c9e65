# SPDX-License-Identifier: Apache-2.0
"""Transfer of parts between the driver and the machines of the tasks: a shared folder, or an object store.

With an object store the command of a task runs in this module as a program, after a :class:`Transfer` as JSON. It
copies inputs into a folder of its machine, and outputs to the store: a growing file repeatedly while the command runs,
results when it succeeded. The folder remains when the command is killed, so that the next attempt of the same run on
this machine continues there; a run that was started again has another folder, and removes the earlier one.
"""

import hashlib
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeVar

from structgstream.atomic_files import atomic_write, partial_path
from structgstream.errors import StorageError, StructGStreamError
from structgstream.evaluation.run_log import log_path
from structgstream.executors.tasks import PYTHON, Task, tied_argv
from structgstream.groups.track_file import groups_path, open_track, track_bytes
from structgstream.owned_folders import MARKER, Owner, own_folder, owner_of, parse_owner, remove_own
from structgstream.parallel.parts import PART_NAMES, Parts
from structgstream.remote_folders import open_url, reason_of, shown_address

T = TypeVar("T")
TRIES = 8
FIRST_DELAY_SECONDS = 0.1
LONGEST_DELAY_SECONDS = 10.0


class ObjectFolder:
    """The objects below ``url`` (in fsspec's syntax), by name; each is a copy of a file.

    Addresses and credentials come from the environment, as the scheme's package reads them (``AWS_ENDPOINT_URL``,
    ``AWS_ACCESS_KEY_ID``, ...). A request that fails is made again, :data:`TRIES` times in all, with growing, varied
    pauses; then it is a ``StorageError``.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self.name = shown_address(self.url)  # for messages
        self._files, self._root = open_url(self.url)

    def write(self, name: str, data: bytes) -> None:
        """Writes or replaces an object."""

        def put() -> None:
            if self._files.protocol in ("file", ("file", "local")):
                self._files.makedirs(str(Path(f"{self._root}/{name}").parent), exist_ok=True)
            self._files.pipe_file(f"{self._root}/{name}", data)

        self._tried(put, f"write {name}", may_miss=False)

    def read(self, name: str) -> bytes | None:
        """The content of an object; None if there is none."""
        return self._tried(lambda: self._files.cat_file(f"{self._root}/{name}"), f"read {name}")

    def size(self, name: str) -> int | None:
        """The bytes of an object; None if there is none."""
        return self._tried(lambda: int(self._files.info(f"{self._root}/{name}")["size"]), f"look for {name}")

    def fetch(self, name: str, path: Path) -> None:
        """Copies an object to a file if there is one."""
        if (data := self.read(name)) is not None:
            atomic_write(path, data, new_folder=True)

    def owner(self) -> Owner | None:
        """The owner of the folder; None if there is nothing in it. Raises StorageError if it holds objects and no
        marker."""
        names = self._all()
        if not names:
            return None
        data = self.read(MARKER) if MARKER in names else None
        found = None if data is None else parse_owner(data)
        if found is None:
            raise StorageError(
                f"{self.name} holds objects and no marker of structgstream ({MARKER}), so they may be somebody else's; "
                "nothing there was changed. Choose a --store that is empty."
            )
        return found

    def remove(self, names: re.Pattern[str]) -> None:
        """Removes the objects of a marked folder whose names match in full; others stay."""
        if self.owner() is not None:
            found = [f"{self._root}/{name}" for name in self._all() if names.fullmatch(name)]
            self._tried(lambda: found and self._files.rm(found), "remove what is")

    def _all(self) -> list[str]:
        """Names of all objects, also of those in folders."""

        def listed() -> list[str]:
            self._files.invalidate_cache()
            return [str(path).removeprefix(f"{self._root}/") for path in self._files.find(self._root)]

        return self._tried(listed, "list the content of") or []

    def _tried(self, action: Callable[[], T], what: str, *, may_miss: bool = True) -> T | None:
        """The result of a request; None for an object that does not exist, if it ``may_miss``."""
        delay = FIRST_DELAY_SECONDS
        for attempt in range(TRIES):
            try:
                return action()
            except Exception as error:  # Each file system has its own.
                if may_miss and isinstance(error, FileNotFoundError):
                    return None
                if attempt + 1 == TRIES:
                    raise StorageError(f"Cannot {what} in {self.name} ({reason_of(error, self.url)}).") from error
            time.sleep(delay * random.uniform(0.5, 1.5))  # so that two processes do not fail in step
            delay = min(2 * delay, LONGEST_DELAY_SECONDS)
        raise AssertionError("unreachable")


STAGED = (PYTHON, "-m", "structgstream.parallel.exchange")
POLL_SECONDS = 1.0


class SharedFolder:
    """All machines see the parts at the same path, so that nothing is copied."""

    def header(self, task: Task) -> Task:
        """The task of frame 0, for its machine."""
        return task

    def track(self, task: Task) -> Task:
        """The task of the tracking pass, for its machine."""
        return task

    def group(self, task: Task, first: int) -> Task:
        """The task of the group that starts at frame ``first``, for its machine."""
        return task

    def fetch(self, part: Path) -> None:
        """Copies a part of a completed task here."""

    def fetch_track(self) -> None:
        """Copies here what the tracking pass has written so far."""


class ObjectStore(SharedFolder):
    """Parts are exchanged through an object store; the driver has copies."""

    def __init__(self, store: ObjectFolder, parts: Parts) -> None:
        self._store, self._parts = store, parts
        self._asked = 0.0
        self._fetched_bytes: int | None = None  # of the growing track

    def header(self, task: Task) -> Task:
        return self._staged(task, gives=[self._parts.header])

    def track(self, task: Task) -> Task:
        track = self._parts.track
        growing = [groups_path(track), partial_path(track)]
        return self._staged(task, needs=[self._parts.header], grows=growing, gives=[track])

    def group(self, task: Task, first: int) -> Task:
        track = self._parts.track.with_name(f"start-{first:06d}.sgt")
        command = tuple(argument.replace(str(self._parts.track), str(track)) for argument in task.command)
        if first:  # The machine gets an unfinished track with the one start that the group needs.
            whole = open_track(self._parts.track)
            self._store.write(self._name(partial_path(track)), track_bytes(whole.head, whole.start(first)))
        segment = Path(task.result)
        return self._staged(
            replace(task, command=command),
            needs=[self._parts.header, partial_path(track)],
            # The segment last: once it is in the store, so is its log.
            gives=[log_path(segment), segment],
        )

    def fetch(self, part: Path) -> None:
        self._store.fetch(self._name(part), part)

    def fetch_track(self) -> None:
        """See :meth:`SharedFolder.fetch_track`; asks the store once a second."""
        if time.monotonic() - self._asked < POLL_SECONDS:
            return
        self._asked = time.monotonic()
        track = self._parts.track
        groups = groups_path(track)
        if not groups.exists():
            self.fetch(groups)
        partial = partial_path(track)
        size = self._store.size(self._name(partial))
        if size not in (None, self._fetched_bytes):
            self.fetch(partial)
            self._fetched_bytes = size

    def check_owner(self, key: str) -> Owner | None:
        """Check that the store may be used for the parts; returns its owner, None if it is empty. A run of the same
        ``key``, the hash of its plan, whose folder of parts was lost is continued. Raises StorageError if it has parts
        of another run, or other files."""
        local, remote = self._parts.check(), self._store.owner()
        if remote is None or (remote.identity == local.identity if local is not None else remote.key == key):
            return remote
        raise StorageError(
            f"{self._store.name} holds the parts of another run than {self._parts.folder}; nothing there was changed. "
            "Choose another --store, or continue that run with its output and options."
        )

    def mark(self, owner: Owner) -> None:
        """Marks the store as owned by the parts."""
        self._store.write(MARKER, owner.content)

    def clear(self) -> None:
        """Removes all parts in the store, and nothing else."""
        self._store.remove(PART_NAMES)

    def _name(self, path: Path) -> str:
        return str(path.relative_to(self._parts.folder))

    def _staged(self, task: Task, **files: Sequence[Path]) -> Task:
        folder = str(self._parts.folder)
        inner = (argument.replace(folder, HERE) for argument in task.command)
        names = {kind: tuple(map(self._name, paths)) for kind, paths in files.items()}
        transfer = Transfer(task.name, self._parts.run, **names)
        environment = {**task.environment, STORE: self._store.url}
        return replace(task, command=(*STAGED, json.dumps(asdict(transfer)), *inner), environment=environment)


@dataclass(frozen=True)
class Transfer:
    """The files of a task, by their names in the store."""

    name: str  # of the task
    run: str = ""  # random name of the run
    needs: tuple[str, ...] = ()  # files to fetch
    gives: tuple[str, ...] = ()  # files to store when the command has ended well, and to fetch before if they are there
    grows: tuple[str, ...] = ()  # files to store while they grow, and to fetch before if not all that is given is there


HERE = "{here}"
"""In an argument of the command: the folder of this machine."""
STORE = "STRUCTGSTREAM_STORE"
"""The variable with the URL of the store. It may hold credentials, and every user of a machine sees command lines."""
SCRATCH = "STRUCTGSTREAM_SCRATCH"
"""The variable that names a folder for files of this machine; without it, that of temporary files."""
PURPOSE = "scratch files of a task"
ANY = re.compile(f"(?!{re.escape(MARKER)}$).*", re.DOTALL)
GROWTH = 1.1
"""Minimum factor by which a growing file is longer when it is stored again."""
SIGNALLED = 128
"""Statuses from this on are those of a signal."""


class Staging:
    """The files of a task on this machine and in the store."""

    def __init__(self, store: ObjectFolder, folder: Path) -> None:
        self.store, self.folder = store, folder
        self._sizes: dict[str, int] = {}

    def fetch(self, name: str, *, replace: bool = False) -> None:
        """Copies a file from the store if it is there and missing here; with ``replace`` even if it is here."""
        if replace or not (self.folder / name).exists():
            self.store.fetch(name, self.folder / name)

    def put(self, name: str) -> None:
        """Copies a file to the store if it exists."""
        if (self.folder / name).exists():
            self.store.write(name, (self.folder / name).read_bytes())

    def put_growing(self, name: str, *, ended: bool) -> None:
        """Replaces a file in the store when it has grown by the factor :data:`GROWTH`, or the command has ended.

        It is stored as a whole, so that the store has a prefix of one attempt, even if another attempt writes, too. The
        factor bounds the bytes sent to a multiple of the file.
        """
        path = self.folder / name
        size, stored = path.stat().st_size if path.exists() else 0, self._sizes.get(name, 0)
        if size < stored or size > stored * (1 if ended else GROWTH):
            self.put(name)
            self._sizes[name] = size


def run(transfer: Transfer, command: Sequence[str]) -> int:
    """Fetches inputs, runs the command and stores outputs; returns its status."""
    url = os.environ[STORE]
    staging = Staging(ObjectFolder(url), scratch_folder(transfer, url))
    for name in transfer.needs:
        staging.fetch(name, replace=True)
    for name in transfer.gives:
        staging.fetch(name)
    if not all((staging.folder / name).exists() for name in transfer.gives):
        for name in transfer.grows:
            staging.fetch(name)
    # Tied, because a command that outlives this process would hold the folder in which the next attempt continues.
    process = subprocess.Popen(tied_argv(tuple(argument.replace(HERE, str(staging.folder)) for argument in command)))
    status = None
    while status is None:
        with suppress(subprocess.TimeoutExpired):
            status = process.wait(POLL_SECONDS)
        for name in transfer.grows:
            staging.put_growing(name, ended=status is not None)
    if status == 0:
        for name in transfer.gives:
            staging.put(name)
    if 0 <= status < SIGNALLED:  # A command that failed by itself would fail again.
        remove_own(staging.folder, PURPOSE, ANY, whole=True)
    if status < 0:  # As the command ended, so that the task counts as killed.
        os.kill(os.getpid(), -status)
    return status


def scratch_folder(transfer: Transfer, url: str) -> Path:
    """The marked folder of a task on this machine; those of earlier runs of the task are removed. Raises StorageError
    if it is somebody else's, or cannot be made."""
    above = Path(os.environ.get(SCRATCH) or tempfile.gettempdir())
    # Names of tasks are unique within a run only.
    task = hashlib.sha256(f"{url}\n{transfer.name}".encode()).hexdigest()[:16]
    folder = above / f"structgstream-{task}-{transfer.run}"
    for earlier in above.glob(f"structgstream-{task}-*"):
        if earlier != folder and (owner := owner_of(earlier)) is not None and owner.purpose == PURPOSE:
            remove_own(earlier, PURPOSE, ANY, whole=True)
    own_folder(folder, PURPOSE)
    return folder


def main() -> int:
    """Runs; an error of the store is one sentence."""
    try:
        return run(Transfer(**json.loads(sys.argv[1])), sys.argv[2:])
    except StructGStreamError as error:
        print(f"structgstream: {error}", file=sys.stderr, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
