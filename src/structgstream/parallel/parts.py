# SPDX-License-Identifier: Apache-2.0
"""The folder of the parts of a stream: header, track, segments, and records of completed tasks.

A part is complete if it has the hash that was recorded when its task succeeded, and the task has the same arguments.
All others (truncated, damaged, of other options) are made again by their commands, which reuse what they can.
"""

import hashlib
import json
import re
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from structgstream.atomic_files import atomic_write, lock_file, open_lockable
from structgstream.errors import ConfigError, StorageError
from structgstream.evaluation.run_log import json_lines
from structgstream.executors.tasks import TaskResult
from structgstream.owned_folders import Owner, check_owned, own_folder, remove_own

PLAN = "plan.json"
COMPLETED = "done.jsonl"
PURPOSE = "parts of a parallel run"
PART_NAMES = re.compile(
    r"(plan\.json|done\.jsonl|header\.(sgs|log\.jsonl|metrics\.json)|track\.sgt(\.groups)?|start-\d{6,}\.sgt"
    r"|segments/group-\d{6,}-\d{6,}\.(sgs|log\.jsonl|metrics\.json)|logs/(header|track|join|group-\d{6,}-\d{6,})\.txt"
    r")(\.partial)?"
)
"""Names of parts, here and in a store; nothing else is removed."""
_RUN = "run"  # key of the plan: a random name, which distinguishes scratch files of one run from those of another
_LOCK = ".driver"


@dataclass(frozen=True)
class CompletedTask:
    """Record of a completed task and its part."""

    name: str  # name of the task
    key: str  # hash of its arguments
    sha256: str  # of the part
    bytes: int  # size of the part
    seconds: float  # duration of the last attempt
    attempts: int  # number of attempts
    peak_bytes: int  # largest resident memory; 0 if unknown
    frames: int  # number of fitted, or tracked, frames


class Parts:
    """The folder of parts, with the records of completed tasks by name."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.completed = read_completed(folder)

    @property
    def header(self) -> Path:
        """The stream of frame 0 alone."""
        return self.folder / "header.sgs"

    @property
    def track(self) -> Path:
        """The file of the tracking pass."""
        return self.folder / "track.sgt"

    def segment(self, first: int, end: int) -> Path:
        """The segment of the frames from ``first`` to before ``end``."""
        return self.folder / "segments" / f"{group_name(first, end)}.sgs"

    def log(self, name: str) -> Path:
        """The output of a task."""
        return self.folder / "logs" / f"{name}.txt"

    def check(self) -> Owner | None:
        """The owner of the folder; None if it is missing or empty. Raises StorageError if it is not one of parts."""
        return check_owned(self.folder, PURPOSE)

    @contextmanager
    def locked(self, *, owner: Owner | None = None) -> Iterator[None]:
        """Creates and marks the folder, by default for a new owner, and locks it for other drivers within the block.
        Raises StorageError if another process uses it, or the folder is not one of parts, or cannot be made."""
        try:
            own_folder(self.folder, PURPOSE, owner=owner)
            (self.folder / "segments").mkdir(exist_ok=True)
            file = open_lockable(self.folder / _LOCK)
        except OSError as error:
            raise StorageError(f"The folder {self.folder} cannot be made ({error.strerror}).") from error
        with file:
            if not lock_file(file, holder="process"):
                raise StorageError(
                    f"Another process makes the parts in {self.folder}; wait for its end, or choose another output."
                )
            yield

    def clear(self) -> None:
        """Removes all parts and records, and nothing else. Raises StorageError if they cannot be removed."""
        # The records go first and the plan last: parts that remain if this is killed are incomplete ones of the plan.
        remove_own(self.folder, PURPOSE, PART_NAMES, order={COMPLETED: 0, PLAN: 2})
        (self.folder / "segments").mkdir(exist_ok=True)
        self.completed.clear()

    @property
    def run(self) -> str:
        """A random name, another one after :meth:`clear`."""
        return str((_json_of(self.folder / PLAN) or {}).get(_RUN, ""))

    def use_plan(self, plan: Mapping[str, Any]) -> None:
        """Records the plan of the parts, or compares it with the recorded one.

        Raises:
            ConfigError: the folder has parts of another plan.
            StorageError: the plan cannot be written.
        """
        path, wanted = self.folder / PLAN, json.loads(json.dumps(plan))
        found = _json_of(path)
        if found is None:
            atomic_write(path, json.dumps({**wanted, _RUN: uuid.uuid4().hex}, indent=1).encode() + b"\n")
            return
        found.pop(_RUN, None)
        if found == wanted:
            return
        first = min(key for key in {*found, *wanted} if found.get(key) != wanted.get(key))
        raise ConfigError(
            f"{self.folder} has parts of another run ({first}: {found.get(first)!r} there, {wanted.get(first)!r} "
            "asked for); choose another output, or give --overwrite to start again."
        )

    def is_complete(self, name: str, key: str, part: Path) -> bool:
        """Whether the part is as it was when its task succeeded."""
        record = self.completed.get(name)
        if record is None or record.key != key:
            return False
        with suppress(OSError):
            return part.stat().st_size == record.bytes and sha256_of(part) == record.sha256
        return False

    def record(self, result: TaskResult, key: str, part: Path, *, frames: int) -> CompletedTask:
        """Records that a task succeeded; the earlier record stays if the part is the same. Raises StorageError if its
        part is missing, or the record cannot be written."""
        try:
            record = CompletedTask(
                result.name,
                key,
                sha256_of(part),
                part.stat().st_size,
                round(result.seconds, 3),
                result.attempts,
                result.peak_bytes,
                frames,
            )
        except OSError as error:
            raise StorageError(
                f"The task {result.name} succeeded, but {part} cannot be read here ({error.strerror}); do all "
                "machines see this folder at the same place?"
            ) from error
        earlier = self.completed.get(record.name)
        if earlier is not None and (earlier.key, earlier.sha256) == (record.key, record.sha256):
            return earlier
        self.completed[record.name] = record
        atomic_write(
            self.folder / COMPLETED, [f"{json.dumps(asdict(each))}\n".encode() for each in self.completed.values()]
        )
        return record


def group_name(first: int, end: int) -> str:
    """The name of a group of frames and of its task."""
    return f"group-{first:06d}-{end:06d}"


def read_completed(folder: Path) -> dict[str, CompletedTask]:
    """The last record of each task; invalid lines are skipped."""
    completed = {}
    for values in json_lines(folder / COMPLETED):
        with suppress(TypeError):
            record = CompletedTask(**values)
            completed[record.name] = record
    return completed


def key_of(*facts: object) -> str:
    """A hash of a task's arguments."""
    return hashlib.sha256(json.dumps(facts, default=str).encode()).hexdigest()[:16]


def sha256_of(path: Path) -> str:
    """Of a file. Raises OSError if it cannot be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _json_of(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None
