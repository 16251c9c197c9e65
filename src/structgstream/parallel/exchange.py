# SPDX-License-Identifier: Apache-2.0
"""Transfer of parts between the driver and the machines of the tasks: a shared folder, or an object store."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from structgstream.atomic_files import atomic_write, partial_path
from structgstream.errors import StorageError
from structgstream.evaluation.run_log import log_path
from structgstream.executors.task import PYTHON, Task
from structgstream.groups.boundaries import groups_path
from structgstream.owned_folders import MARKER, Owner
from structgstream.parallel.object_folder import ObjectFolder
from structgstream.parallel.parts import PART_NAMES, Parts
from structgstream.parallel.staged import HERE, STORE
from structgstream.parallel.unit import CutsTrack

STAGED = (PYTHON, "-m", "structgstream.parallel.staged")
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
    """Parts are exchanged through an object store; the driver has copies.

    Args:
        store: the folder of the store.
        parts: the driver's folder.
        cut: extracts from a track what one group needs.
    """

    def __init__(self, store: ObjectFolder, parts: Parts, *, cut: CutsTrack) -> None:
        self._store, self._parts, self._cut = store, parts, cut
        self._asked = 0.0
        self._fetched_bytes: int | None = None  # of the growing track

    def header(self, task: Task) -> Task:
        """See :meth:`SharedFolder.header`."""
        return self._staged(task, ["--gives", self._name(self._parts.header)])

    def track(self, task: Task) -> Task:
        """See :meth:`SharedFolder.track`."""
        track = self._parts.track
        files = ["--needs", self._name(self._parts.header)]
        files += ["--grows", self._name(groups_path(track)), "--grows", self._name(partial_path(track))]
        return self._staged(task, [*files, "--gives", self._name(track)])

    def group(self, task: Task, first: int) -> Task:
        """See :meth:`SharedFolder.group`."""
        track = self._parts.track.with_name(f"start-{first:06d}.sgt")
        command = tuple(argument.replace(str(self._parts.track), str(track)) for argument in task.command)
        partial = self._name(partial_path(track))
        if first:
            self._store.write(partial, self._cut(self._parts.track, first))
        segment = Path(task.result)
        log = log_path(segment)
        files = ["--needs", self._name(self._parts.header), "--needs", partial]
        # The segment last: once it is in the store, so is its log.
        files += ["--gives", self._name(log), "--gives", self._name(segment)]
        return self._staged(replace(task, command=command), files)

    def fetch(self, part: Path) -> None:
        """See :meth:`SharedFolder.fetch`."""
        if (data := self._store.read(self._name(part))) is not None:
            atomic_write(part, data, new_folder=True)

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
        """Check that the store may be used for the parts; returns its owner, None if it is empty.

        Args:
            key: hash of the plan. A run of the same key whose folder of parts was lost is continued.

        Raises:
            StorageError: it has parts of another run, or other files.
        """
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

    def _staged(self, task: Task, files: Sequence[str]) -> Task:
        folder = str(self._parts.folder)
        inner = (argument.replace(folder, HERE) for argument in task.command)
        outer = (*STAGED, "--name", task.name, "--run", self._parts.run, *files, "--")
        environment = {**task.environment, STORE: self._store.url}
        return replace(task, command=(*outer, *inner), environment=environment)
