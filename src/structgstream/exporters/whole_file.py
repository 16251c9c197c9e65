# SPDX-License-Identifier: Apache-2.0
"""Atomic writing of files."""

import os
from collections.abc import Iterable
from pathlib import Path

from structgstream.errors import StorageError


def write_whole(path: Path, parts: Iterable[bytes | memoryview]) -> None:
    """Writes ``parts``, one after the other, as the file ``path``, and makes its folder when it is missing.

    An existing file at ``path`` is replaced only when the new one is complete.

    Raises:
        StorageError: the file cannot be written.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with partial.open("wb") as file:
                file.writelines(parts)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    except OSError as error:
        reason = f"{path.parent} is a file" if path.parent.is_file() else error.strerror
        raise StorageError(f"{path} cannot be written ({reason}).") from None
