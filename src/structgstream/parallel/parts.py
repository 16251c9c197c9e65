# SPDX-License-Identifier: Apache-2.0
"""The folder in which the parts of a stream come together: header, track, segments, and notes of what is whole.

A part is whole when it has the hash that was noted when its task ended well, and the task is the same as then. Nothing
else is believed: what was cut or has rotted since, or is of other options, is made again by its command, which takes
from it what it can.
"""

import hashlib
import json
import re
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from structgstream.atomic_files import atomic_write
from structgstream.errors import ConfigError, StorageError
from structgstream.executors.task import TaskResult
from structgstream.file_locks import lock_file, open_lockable
from structgstream.owned_folders import Owner, check_owned, own_folder, remove_own

PLAN = "plan.json"
NOTES = "done.jsonl"
PURPOSE = "parts of a parallel run"
OURS = re.compile(
    r"(plan\.json|done\.jsonl|header\.(sgs|log\.jsonl|metrics\.json)|track\.sgt(\.groups)?|start-\d{6,}\.sgt"
    r"|segments/group-\d{6,}-\d{6,}\.(sgs|log\.jsonl|metrics\.json)|logs/(header|track|join|group-\d{6,}-\d{6,})\.txt"
    r")(\.partial)?"
)
"""Names that parts have, here and in a store; nothing else is removed."""
_RUN = "run"  # of the plan: what tells scratch files of one beginning from those of another
_LOCK = ".driver"
_PIECE_BYTES = 2**20


@dataclass(frozen=True)
class Note:
    """That a task has ended well, and what it has left.

    Args:
        name: of the task.
        key: hash of what it was asked for.
        sha256: of the part.
        bytes: of the part.
        seconds: that it took, of the last attempt.
        attempts: how often it was begun.
        peak_bytes: largest resident memory; 0 where that is not known.
        frames: that it has fitted, or tracked.
    """

    name: str
    key: str
    sha256: str
    bytes: int
    seconds: float
    attempts: int
    peak_bytes: int
    frames: int


class Parts:
    """The folder of parts, and what is noted of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.notes = read_notes(folder)

    @property
    def header(self) -> Path:
        """The stream of frame 0 alone."""
        return self.folder / "header.sgs"

    @property
    def track(self) -> Path:
        """What the tracking pass writes."""
        return self.folder / "track.sgt"

    def segment(self, first: int, end: int) -> Path:
        """The segment of the frames from ``first`` to before ``end``."""
        return self.folder / "segments" / f"{group_name(first, end)}.sgs"

    def log(self, name: str) -> Path:
        """What the task prints."""
        return self.folder / "logs" / f"{name}.txt"

    def check(self) -> Owner | None:
        """The owner of the folder; None if it is missing or empty.

        Raises:
            StorageError: it is not one of parts.
        """
        return check_owned(self.folder, PURPOSE)

    @contextmanager
    def held(self, *, owner: Owner | None = None) -> Iterator[None]:
        """Makes and marks the folder, and keeps other drivers from it within the block.

        Args:
            owner: of a folder that is made; None for a new one.

        Raises:
            StorageError: another process drives here, or the folder is not one of parts, or cannot be made.
        """
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
        """Removes all parts and notes, and nothing else.

        Raises:
            StorageError: they cannot be removed.
        """
        # Killed before its end, what is left is still parts of the old plan, and none of them is believed.
        remove_own(self.folder, PURPOSE, OURS, order={NOTES: 0, PLAN: 2})
        (self.folder / "segments").mkdir(exist_ok=True)
        self.notes.clear()

    @property
    def run(self) -> str:
        """A name that is another one after every beginning anew."""
        return str((_json_of(self.folder / PLAN) or {}).get(_RUN, ""))

    def keep_to(self, plan: Mapping[str, Any]) -> None:
        """Notes what the parts are of, or checks it.

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
            "asked for); choose another output, or give --overwrite to begin anew."
        )

    def is_whole(self, name: str, key: str, part: Path) -> bool:
        """Whether the part is there as it was when its task ended."""
        note = self.notes.get(name)
        if note is None or note.key != key:
            return False
        try:
            return part.stat().st_size == note.bytes and sha256_of(part) == note.sha256
        except OSError:
            return False

    def note(self, ending: TaskResult, key: str, part: Path, *, frames: int) -> Note:
        """Notes that a task has ended well; one that has only found its part whole again is noted already.

        Raises:
            StorageError: its part is not there, or the note cannot be written.
        """
        try:
            note = Note(
                ending.name,
                key,
                sha256_of(part),
                part.stat().st_size,
                round(ending.seconds, 3),
                ending.attempts,
                ending.peak_bytes,
                frames,
            )
        except OSError as error:
            raise StorageError(
                f"The task {ending.name} has ended well, but {part} cannot be read here ({error.strerror}); do all "
                "machines see this folder at the same place?"
            ) from error
        earlier = self.notes.get(note.name)
        if earlier is not None and (earlier.key, earlier.sha256) == (note.key, note.sha256):
            return earlier
        self.notes[note.name] = note
        atomic_write(self.folder / NOTES, [f"{json.dumps(asdict(each))}\n".encode() for each in self.notes.values()])
        return note


def group_name(first: int, end: int) -> str:
    """The name of a group of frames and of its task."""
    return f"group-{first:06d}-{end:06d}"


def read_notes(folder: Path) -> dict[str, Note]:
    """The last note of each task; what is no note is passed over."""
    try:
        lines = (folder / NOTES).read_text().splitlines()
    except OSError:
        return {}
    notes = {}
    for line in lines:
        try:
            note = Note(**json.loads(line))
        except (ValueError, TypeError):
            continue
        notes[note.name] = note
    return notes


def key_of(*facts: object) -> str:
    """A hash of what a task is asked for."""
    return hashlib.sha256(json.dumps(facts, default=str).encode()).hexdigest()[:16]


def sha256_of(path: Path) -> str:
    """Of a file, which is read in pieces.

    Raises:
        OSError: it cannot be read.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(_PIECE_BYTES):
            digest.update(piece)
    return digest.hexdigest()


def _json_of(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
