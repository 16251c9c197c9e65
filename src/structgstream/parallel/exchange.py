# SPDX-License-Identifier: Apache-2.0
"""How parts come from the machines that make them to the driver, and the other way: a shared folder, or a store."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from structgstream.errors import StorageError
from structgstream.evaluation.run_log import log_path
from structgstream.executors.task import PYTHON, Task
from structgstream.groups.group_list import groups_path
from structgstream.owned_folders import MARKER, Owner
from structgstream.parallel.object_folder import ObjectFolder
from structgstream.parallel.parts import OURS, Parts
from structgstream.parallel.pieces import last_pieces
from structgstream.parallel.staged import HERE, STORE
from structgstream.parallel.unit import CutsTrack
from structgstream.whole_files import partial_path, write_whole

STAGED = (PYTHON, "-m", "structgstream.parallel.staged")
LOOK_SECONDS = 1.0


class Exchange(Protocol):
    """What the driver asks of it."""

    def header(self, task: Task) -> Task:
        """The task of frame 0, for where it runs."""
        ...

    def track(self, task: Task) -> Task:
        """The task of the tracking pass, for where it runs."""
        ...

    def group(self, task: Task, first: int) -> Task:
        """The task of a group that begins at a frame whose start is here, for where it runs."""
        ...

    def bring(self, part: Path) -> None:
        """Brings a part here that a task has made."""
        ...

    def follow(self) -> None:
        """Brings here what the tracking pass has written by now."""
        ...


class SharedFolder:
    """All machines see the parts at the same place."""

    def header(self, task: Task) -> Task:
        """See ``Exchange.header``."""
        return task

    def track(self, task: Task) -> Task:
        """See ``Exchange.track``."""
        return task

    def group(self, task: Task, first: int) -> Task:
        """See ``Exchange.group``."""
        return task

    def bring(self, part: Path) -> None:
        """See ``Exchange.bring``."""

    def follow(self) -> None:
        """See ``Exchange.follow``."""


class ObjectStore:
    """Parts meet in an object store; the driver keeps copies.

    Args:
        store: the folder of the store.
        parts: the driver's folder.
        cut: takes from a track what one group needs.
    """

    def __init__(self, store: ObjectFolder, parts: Parts, *, cut: CutsTrack) -> None:
        self._store, self._parts, self._cut = store, parts, cut
        self._looked = 0.0
        self._followed = ""  # the attempt at the track that is copied here

    def header(self, task: Task) -> Task:
        """See ``Exchange.header``."""
        return self._staged(task, ["--gives", self._name(self._parts.header)])

    def track(self, task: Task) -> Task:
        """See ``Exchange.track``."""
        name = self._name(self._parts.track)
        files = ["--needs", self._name(self._parts.header), "--grows", name, "--early", f"{name}.groups"]
        return self._staged(task, files)

    def group(self, task: Task, first: int) -> Task:
        """See ``Exchange.group``."""
        track = self._parts.track.with_name(f"start-{first:06d}.sgt")
        command = tuple(word.replace(str(self._parts.track), str(track)) for word in task.command)
        partial = self._name(partial_path(track))
        if first:
            self._store.write(partial, self._cut(self._parts.track, first))
        segment = Path(task.result)
        log = log_path(segment)
        files = ["--needs", self._name(self._parts.header), "--needs", partial]
        # The segment last: who finds it in the store finds its log.
        files += ["--gives", self._name(log), "--gives", self._name(segment)]
        return self._staged(replace(task, command=command), files)

    def bring(self, part: Path) -> None:
        """See ``Exchange.bring``."""
        if (data := self._store.read(self._name(part))) is not None:
            write_whole(part, data, new_folder=True)

    def follow(self) -> None:
        """See ``Exchange.follow``; asks the store once a second."""
        if time.monotonic() - self._looked < LOOK_SECONDS:
            return
        self._looked = time.monotonic()
        track = self._parts.track
        groups = groups_path(track)
        if not groups.exists():
            self.bring(groups)
        partial, pieces = partial_path(track), last_pieces(self._store, self._name(track))
        if pieces.attempt != self._followed:
            write_whole(partial, pieces.read(self._store))
            self._followed = pieces.attempt
        elif pieces.attempt:
            with partial.open("ab") as file:
                file.write(pieces.read(self._store, have=file.tell()))

    def claim(self, key: str) -> Owner | None:
        """Check that the store may be used for the parts; whose it is, None if it is empty.

        Args:
            key: hash of what the run is asked for. A run of the same key whose folder of parts was lost is continued.

        Raises:
            StorageError: it holds what is not of these parts.
        """
        here, there = self._parts.check(), self._store.owner()
        if there is None or (there.identity == here.identity if here is not None else there.key == key):
            return there
        raise StorageError(
            f"{self._store.name} holds the parts of another run than {self._parts.folder}; nothing there was changed. "
            "Choose another --store, or go on with the output and the options of that run."
        )

    def mark(self, owner: Owner) -> None:
        """Marks the store as that of the parts."""
        self._store.write(MARKER, owner.content)

    def clear(self) -> None:
        """Removes all parts in the store, and nothing else."""
        self._store.remove(OURS)

    def _name(self, path: Path) -> str:
        return str(path.relative_to(self._parts.folder))

    def _staged(self, task: Task, files: Sequence[str]) -> Task:
        folder = str(self._parts.folder)
        inner = (word.replace(folder, HERE) for word in task.command)
        outer = (*STAGED, "--name", task.name, "--run", self._parts.run, *files, "--")
        environment = {**task.environment, STORE: self._store.url}
        return replace(task, command=(*outer, *inner), environment=environment)
