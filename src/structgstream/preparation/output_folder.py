# SPDX-License-Identifier: Apache-2.0
"""The folder of a capture: whose it is, who writes to it, the results of steps, and how what was filmed gets into it.

A folder of other videos, one made by hand, or one that another process prepares is not written into. Files are linked
where that is possible, so that nothing is stored twice.

A step with the same inputs and options is not done again. Its result is ``work/STEP.json`` (numbers, and the key) and
``work/STEP.npz`` (arrays). The key is a hash of the step's inputs and of the keys of the steps before it; the JSON is
written last, so what an interruption leaves is done again.
"""

import hashlib
import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import give_name, lock_file, open_lockable, partial_path, replacing
from structgstream.errors import CaptureError, StorageError
from structgstream.preparation.options import Link

FOLDER = "work"
VERSION = 5  # of the steps' results; a new one does all steps again
Value = TypeVar("Value")


@dataclass(frozen=True)
class Stored:
    """What a step leaves: ``values`` are what JSON holds, ``arrays`` plain arrays by name."""

    values: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Packing(Generic[Value]):
    """How results of a kind are stored."""

    pack: Callable[[Value], Stored]
    unpack: Callable[[Stored], Value]  # the reverse


def plain(name: str) -> Packing[Any]:
    """One value that JSON can hold, under a name."""
    return Packing(lambda value: Stored({name: value}), lambda stored: stored.values[name])


class Listener(Protocol):
    """Receives steps as they run."""

    def begin(self, step: str, *, skipped: bool) -> None:
        """A step begins; ``skipped`` when its result is there already."""

    def progress(self, done: int, total: int, what: str) -> None:
        """A part of the running step is done."""

    def end(self, step: str, summary: str) -> None:
        """A step is done; ``summary`` describes its result."""


class Silent(Listener):
    """A listener that does nothing."""


class Steps(Listener):
    """Runs the steps of one capture, reports them to ``listener``, and records their summaries; results go to ``work``
    in it.

    Attributes:
        skipped: steps whose results were there already.
        summaries: of each step, for users.
    """

    def __init__(self, capture: Path, listener: Listener) -> None:
        self._folder = capture / FOLDER
        self._listener = listener
        self._keys: dict[str, str] = {}
        self.skipped: list[str] = []
        self.summaries: dict[str, str] = {}

    def begin(self, step: str, *, skipped: bool = False) -> None:
        self._listener.begin(step, skipped=skipped)

    def progress(self, done: int, total: int, what: str) -> None:
        self._listener.progress(done, total, what)

    def end(self, step: str, summary: str) -> None:
        self.summaries[step] = summary
        self._listener.end(step, summary)

    def run(
        self,
        step: str,
        inputs: Mapping[str, object],
        compute: Callable[[], Value],
        packing: Packing[Value],
        *,
        summary: Callable[[Value], str],
        after: tuple[str, ...] = (),
    ) -> Value:
        """The result of a step, from the disk when its inputs are the same.

        Args:
            inputs: what it depends on apart from other steps, as JSON can hold it.
            summary: the result in one line.
            after: steps whose results it uses.

        Raises:
            StorageError: the result cannot be written.
        """
        described = {"version": VERSION, "step": step, "inputs": inputs, "after": [self._keys[name] for name in after]}
        key = hashlib.sha256(json.dumps(described, sort_keys=True, default=str).encode()).hexdigest()
        self._keys[step] = key
        stored = self._read(step, key)
        self.begin(step, skipped=stored is not None)
        if stored is not None:
            self.skipped.append(step)
            value = packing.unpack(stored)
        else:
            value = compute()
            self._write(step, key, packing.pack(value))
        self.end(step, summary(value))
        return value

    def _read(self, step: str, key: str) -> Stored | None:
        try:
            content = json.loads((self._folder / f"{step}.json").read_text())
            if content["key"] != key:
                return None
            # Opened here, because numpy leaves a damaged file open.
            with (self._folder / f"{step}.npz").open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return Stored(content["values"], {name: arrays[name] for name in arrays.files})
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error):
            return None  # missing, cut or damaged: the step is done again

    def _write(self, step: str, key: str, stored: Stored) -> None:
        numbers, arrays = self._folder / f"{step}.json", self._folder / f"{step}.npz"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            numbers.unlink(missing_ok=True)
            with replacing(arrays) as file:
                np.savez_compressed(file, **stored.arrays)  # pyright: ignore[reportArgumentType]
            with replacing(numbers) as file:
                file.write(f"{json.dumps({'key': key, 'values': stored.values}, indent=1)}\n".encode())
        except OSError as error:
            raise StorageError(
                f"The result of step {step!r} cannot be written to {self._folder} ({error.strerror}); make room, or "
                "let yourself write there, and run the command again: it goes on from there."
            ) from None


def fingerprint(files: Mapping[str, Path]) -> list[tuple[str, str, int, int]]:
    """Identifies the contents of files and folders without reading them: name, file, size and modification time of
    each."""
    found = []
    for name, path in files.items():
        folder = path if path.is_dir() else path.parent
        for file in sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]:
            status = file.stat()
            found.append((name, file.relative_to(folder).as_posix(), status.st_size, status.st_mtime_ns))
    return found


SOURCE = "source.json"
LOCK = ".preparing"
_MARKS = (Path(FOLDER), partial_path(Path(FOLDER, SOURCE)))
"""What a mark that was interrupted or met a full disk leaves in a folder, which is as free as before."""


def mark_output(capture: Path, videos: Path) -> None:
    """Marks ``capture`` as the one of these videos; a ``CaptureError`` where it is something else's folder."""
    marker = capture / FOLDER / SOURCE
    origin = str(videos.resolve())
    if capture.resolve() == videos.resolve():
        raise CaptureError(f"The capture cannot be the folder of the videos itself, {videos}; choose another with -o.")
    if capture.exists() and not capture.is_dir():
        raise CaptureError(f"{capture} is a file; choose a folder with -o.")
    if marker.is_file():
        before = None
        with suppress(OSError, ValueError, KeyError, TypeError):
            before = str(json.loads(marker.read_text())["videos"])
        if before != origin:
            raise CaptureError(
                f"{capture} was prepared from {before}, not from {origin}; choose another folder with -o, or remove it."
            )
        return
    if any(entry.relative_to(capture) not in _MARKS for entry in capture.rglob("*")):
        raise CaptureError(f"The folder {capture} is not empty and was not made by prepare; choose another with -o.")
    try:
        marker.parent.mkdir(parents=True, exist_ok=True)
        with replacing(marker) as file:
            file.write(f"{json.dumps({'videos': origin})}\n".encode())
    except OSError as error:
        raise StorageError(f"The folder {capture} cannot be written ({error.strerror}).") from None


@contextmanager
def lock_output(capture: Path) -> Iterator[None]:
    """No other process prepares the same marked capture within the block; where one does, a ``StorageError`` says
    so."""
    try:
        file = open_lockable(capture / FOLDER / LOCK)
    except OSError as error:
        raise StorageError(f"The folder {capture} cannot be written ({error.strerror}).") from None
    with file:
        if not lock_file(file):
            raise StorageError(
                f"Another process prepares {capture} now; wait for its end, or choose another folder with -o."
            )
        yield


def link(source: Path, target: Path, *, how: Link) -> None:
    """Makes ``target`` the file or the folder of files ``source``; what is there already stays.

    ``how`` is ``hard`` links, and copies where file systems differ; ``symlink`` to the source; or ``copy``.
    """
    try:
        if source.is_dir():
            target.mkdir(parents=True, exist_ok=True)
            for file in sorted(entry for entry in source.iterdir() if entry.is_file()):
                _link_file(file, target / file.name, how)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            _link_file(source, target, how)
    except OSError as error:
        raise StorageError(
            f"{source} cannot be linked or copied to {target} ({error.strerror}); make room, or use --link symlink."
        ) from None


def remove_others(folder: Path, names: Collection[str]) -> None:
    """Removes files that an earlier run linked into ``folder`` and whose names are not among ``names``."""
    for file in sorted(entry for entry in folder.iterdir() if entry.name not in names and not entry.is_dir()):
        _remove(file)


def unlink(source: Path, target: Path) -> None:
    """Removes what :func:`link` made of ``source``, a file or a folder of files; other files stay."""
    if source.is_dir():
        for file in sorted(entry for entry in source.iterdir() if entry.is_file()):
            unlink(file, target / file.name)
        if target.is_dir() and not any(target.iterdir()):
            target.rmdir()
    elif target.is_file() and any(_same(source, target, how) for how in ("hard", "symlink", "copy")):
        _remove(target)


def _remove(file: Path) -> None:
    try:
        file.unlink()
    except OSError as error:
        raise StorageError(
            f"{file} belongs to no camera now and cannot be removed ({error.strerror}); remove it."
        ) from None


def _link_file(source: Path, target: Path, how: Link) -> None:
    if _same(source, target, how):
        return
    target.unlink(missing_ok=True)
    source = source.resolve()
    if how == "symlink":
        target.symlink_to(source)
        return
    if how == "hard":
        try:
            os.link(source, target)
            return
        except OSError:  # another file system, or one without links
            pass
    part = partial_path(target)
    try:
        shutil.copy2(source, part)
        give_name(part, target)
    except BaseException:  # a full disk is full of it
        part.unlink(missing_ok=True)
        raise


def _same(source: Path, target: Path, how: Link) -> bool:
    """Whether the target was made by an earlier run."""
    if not target.exists():
        return False
    if how == "symlink" or target.is_symlink():
        return how == "symlink" and target.is_symlink() and target.resolve() == source.resolve()
    if target.samefile(source):
        return how != "copy"
    one, other = source.stat(), target.stat()
    return (one.st_size, one.st_mtime_ns) == (other.st_size, other.st_mtime_ns)
