# SPDX-License-Identifier: Apache-2.0
"""A preparation and the results of its steps on the disk: a step with the same inputs and options is not done again.

A result is ``work/STEP.json`` (numbers, and the key) and ``work/STEP.npz`` (arrays). The key is a hash of the step's
inputs and of the keys of the steps before it; the JSON is written last, so what an interruption leaves is done again.
"""

import hashlib
import json
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import replacing
from structgstream.errors import StorageError

FOLDER = "work"
VERSION = 4  # of the steps' results; a new one does all steps again
Value = TypeVar("Value")


@dataclass(frozen=True)
class Stored:
    """What a step leaves: ``values`` are what JSON holds, ``arrays`` plain arrays by name."""

    values: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


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
        *,
        pack: Callable[[Value], Stored],
        unpack: Callable[[Stored], Value],
        summary: Callable[[Value], str],
        after: tuple[str, ...] = (),
    ) -> Value:
        """The result of a step, from the disk when its inputs are the same.

        Args:
            inputs: what it depends on apart from other steps, as JSON can hold it.
            pack: the result as numbers and arrays, of which ``unpack`` makes it.
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
            value = unpack(stored)
        else:
            value = compute()
            self._write(step, key, pack(value))
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
        inside = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
        for file in inside:
            status = file.stat()
            inner = file.relative_to(path).as_posix() if path.is_dir() else file.name
            found.append((name, inner, status.st_size, status.st_mtime_ns))
    return found
