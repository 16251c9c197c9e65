# SPDX-License-Identifier: Apache-2.0
"""A file that grows on one machine and is read on others: its pieces in an object store.

Note [Attempts]
~~~~~~~~~~~~~~~
A command that was killed leaves a record that is cut. The next attempt at it goes on before that record, perhaps on a
machine whose rounding makes other bytes, and what was killed may turn out to be alive. So pieces of two attempts do not
fit together: every attempt has a name of its own, under which the store gets all that the file has, from its first byte
on, and who reads takes the pieces of the last attempt, and takes them anew when there is another one. A command cuts
off such a record only some time after its attempt has begun; a file that is no longer what was taken of it therefore
begins another attempt, too.
"""

import hashlib
import re
import uuid
from dataclasses import dataclass
from pathlib import Path

from structgstream.parallel.object_folder import ObjectFolder
from structgstream.whole_files import partial_path

_NAME = re.compile(r"(\d{6}-[0-9a-f]{8})-(\d{15})")


@dataclass(frozen=True)
class Pieces:
    """What the store has of a growing file (Note [Attempts]).

    Args:
        attempt: name of the last attempt; empty if there is none.
        names: the pieces in the store by where they begin, ascending.
    """

    attempt: str
    names: dict[int, str]

    def read(self, store: ObjectFolder, *, have: int = 0) -> bytes:
        """The bytes from ``have`` on, as far as they are there without a gap."""
        data = b""
        for begins, next_begins in zip(self.names, [*self.names, None][1:], strict=True):
            if next_begins is not None and next_begins <= have:
                continue  # All of it is there already.
            content = store.read(self.names[begins])
            if content is None or begins > have + len(data):
                break
            data += content[have + len(data) - begins :]
        return data


def folder_of(name: str) -> str:
    """The folder of the store with the pieces of a file."""
    return f"{name}.pieces"


def piece_name(name: str, attempt: str, begins: int) -> str:
    """The name in the store of the piece of a file that begins at a byte."""
    return f"{folder_of(name)}/{attempt}-{begins:015d}"


def last_pieces(store: ObjectFolder, name: str) -> Pieces:
    """The pieces of the last attempt at a file."""
    attempts: dict[str, dict[int, str]] = {}
    for piece in store.names(folder_of(name)):
        if (match := _NAME.fullmatch(piece.rsplit("/", 1)[-1])) is not None:
            attempts.setdefault(match[1], {})[int(match[2])] = piece
    last = max(attempts, default="")
    return Pieces(last, attempts.get(last, {}))


class GrowingCopy:
    """Copies a file to the store while it grows.

    Args:
        store: where its pieces go.
        name: of the file in the store.
        of: the file, when it is whole; before that it has the name of :func:`partial_path`.
    """

    def __init__(self, store: ObjectFolder, name: str, *, of: Path) -> None:
        self._store, self._name, self._path = store, name, of
        self._begin()

    def take(self) -> None:
        """Takes to the store what is new.

        Raises:
            StorageError: the store does not take it.
        """
        data = self._content()
        if len(data) == self._have:
            return
        if hashlib.sha256(data[: self._have]).digest() != self._digest:
            self._begin()
        if data:
            self._store.write(piece_name(self._name, self._attempt, self._have), data[self._have :])
        self._have, self._digest = len(data), hashlib.sha256(data).digest()

    def _begin(self) -> None:
        """Another attempt, of which the store has nothing."""
        number = int(last_pieces(self._store, self._name).attempt.partition("-")[0] or 0)
        self._attempt = f"{number + 1:06d}-{uuid.uuid4().hex[:8]}"
        self._have, self._digest = 0, hashlib.sha256(b"").digest()

    def _content(self) -> bytes:
        for path in (partial_path(self._path), self._path):
            try:
                return path.read_bytes()
            except OSError:
                continue
        return b""
