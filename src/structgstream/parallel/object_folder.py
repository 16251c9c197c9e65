# SPDX-License-Identifier: Apache-2.0
"""Files under a URL, such as a folder of an object store, that all machines of a run see."""

import random
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from structgstream.errors import StorageError
from structgstream.owned_folders import MARKER, Owner, parse_owner
from structgstream.remote_folders import open_url, reason_of, shown_address

T = TypeVar("T")
TRIES = 8
FIRST_DELAY_SECONDS = 0.1
LONGEST_DELAY_SECONDS = 10.0


class ObjectFolder:
    """Objects by name, with the bytes of the files that they are copies of.

    A request that fails is made again, :data:`TRIES` times in all, with growing, varied pauses.

    Args:
        url: of the folder, as fsspec takes it. Addresses and credentials come from the environment, as the scheme's
            package reads them (``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ...).

    Raises:
        MissingExtraError: fsspec, or the package for this scheme, is not installed.
        StorageError: the URL is not understood.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self.name = shown_address(self.url)
        """For messages."""
        self._files, self._root = open_url(self.url)

    def write(self, name: str, data: bytes) -> None:
        """Writes or replaces an object.

        Raises:
            StorageError: it cannot be written.
        """

        def put() -> None:
            if self._files.protocol in ("file", ("file", "local")):
                self._files.makedirs(str(Path(f"{self._root}/{name}").parent), exist_ok=True)
            self._files.pipe_file(f"{self._root}/{name}", data)

        self._tried(put, f"write {name}")

    def read(self, name: str) -> bytes | None:
        """The content of an object; None if there is none.

        Raises:
            StorageError: it cannot be read.
        """

        def get() -> bytes | None:
            try:
                return self._files.cat_file(f"{self._root}/{name}")
            except FileNotFoundError:
                return None

        return self._tried(get, f"read {name}")

    def size(self, name: str) -> int | None:
        """The bytes of an object; None if there is none.

        Raises:
            StorageError: the store cannot be asked.
        """

        def found() -> int | None:
            try:
                return int(self._files.info(f"{self._root}/{name}")["size"])
            except FileNotFoundError:
                return None

        return self._tried(found, f"look for {name}")

    def owner(self) -> Owner | None:
        """Whose the folder is; None if there is nothing in it.

        Raises:
            StorageError: it holds objects and no marker, or cannot be listed.
        """
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
        """Removes the objects of a marked folder whose names match in full; others stay.

        Raises:
            StorageError: the folder is not marked, or they cannot be removed.
        """
        if self.owner() is None:
            return

        def removed() -> None:
            if found := [f"{self._root}/{name}" for name in self._all() if names.fullmatch(name)]:
                self._files.rm(found)

        self._tried(removed, "remove what is")

    def _all(self) -> list[str]:
        """Names of all objects, also of those in folders."""

        def listed() -> list[str]:
            self._files.invalidate_cache()
            try:
                return [str(path).removeprefix(f"{self._root}/") for path in self._files.find(self._root)]
            except FileNotFoundError:
                return []

        return self._tried(listed, "list the content of")

    def _tried(self, action: Callable[[], T], what: str) -> T:
        delay = FIRST_DELAY_SECONDS
        for attempt in range(TRIES):
            try:
                return action()
            except Exception as error:  # Each file system has its own.
                if attempt + 1 == TRIES:
                    raise StorageError(f"Cannot {what} in {self.name} ({reason_of(error, self.url)}).") from error
            time.sleep(delay * random.uniform(0.5, 1.5))  # so that two processes do not fail in step
            delay = min(2 * delay, LONGEST_DELAY_SECONDS)
        raise AssertionError("unreachable")
