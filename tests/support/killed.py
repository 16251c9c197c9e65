# SPDX-License-Identifier: Apache-2.0
"""What a process leaves that is killed between any two of its operations on files."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

_LOOKS = {"stat", "lstat", "fstat", "fspath", "getpid", "getcwd", "listdir", "scandir", "access", "get_terminal_size"}


def folders_of_the_killed(root: Path, act: Callable[[Path], object], *, begin: Callable[[Path], object]) -> list[Path]:
    """A folder for each state in which a kill would leave the files, in their order; the last is that of the end.

    They are copies that are made before each operation: what is not flushed is not on the disk, so a kill there would
    lose it as the copy does.

    Args:
        root: holds the folders.
        act: is run once, on a folder.
        begin: makes the folder what it is before.
    """
    folder = root / "acted"
    folder.mkdir()
    begin(folder)
    folders: list[Path] = []
    last: dict[str, bytes | None] = {}

    def copy() -> None:
        nonlocal last
        now = _content(folder)
        if not folders or now != last:
            last = now
            folders.append(root / f"killed-{len(folders):03d}")
            shutil.copytree(folder, folders[-1], symlinks=True)

    def watch(frame: FrameType, event: str, called: object) -> None:
        if event == "c_call" and _changes_files(called):
            copy()

    outer = sys.getprofile()
    sys.setprofile(watch)
    try:
        act(folder)
    finally:
        sys.setprofile(outer)
    copy()
    return folders


def _content(folder: Path) -> dict[str, bytes | None]:
    """Bytes of files and None of folders by path."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def _changes_files(called: object) -> bool:
    module = getattr(called, "__module__", None) or type(getattr(called, "__self__", None)).__module__
    return module in ("posix", "fcntl", "_io") and getattr(called, "__name__", "") not in _LOOKS
