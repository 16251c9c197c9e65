# SPDX-License-Identifier: Apache-2.0
"""Runs a command with files in an object store, as a program: ``python -m structgstream.parallel.staged``.

Inputs (``--needs``) are copied into a folder of this machine, outputs to the store: a growing file (``--grows``)
repeatedly while the command runs, results (``--gives``) when it succeeded. The folder remains when the command is
killed, so that the next attempt of the same run on this machine continues there; a run that was started again
(``--run``) has another folder, and removes the earlier one.
"""

import argparse
import hashlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.errors import StructGStreamError
from structgstream.executors.task import argv_of
from structgstream.owned_folders import MARKER, own_folder, owner_of, remove_own
from structgstream.parallel.object_folder import ObjectFolder

HERE = "{here}"
"""In an argument of the command: the folder of this machine."""
STORE = "STRUCTGSTREAM_STORE"
"""The variable with the URL of the store. It may hold credentials, and every user of a machine sees command lines."""
SCRATCH = "STRUCTGSTREAM_SCRATCH"
"""The variable that names a folder for files of this machine; without it, that of temporary files."""
PURPOSE = "scratch files of a task"
ANY = re.compile(f"(?!{re.escape(MARKER)}$).*", re.DOTALL)
POLL_SECONDS = 1.0
GROWTH = 1.1
"""Minimum factor by which a growing file is longer when it is stored again."""
SIGNALLED = 128
"""Statuses from this on are those of a signal."""


class Staging:
    """The files of a task on this machine and in the store."""

    def __init__(self, store: ObjectFolder, folder: Path) -> None:
        self.store, self.folder = store, folder
        self._sizes: dict[str, int] = {}

    def fetch(self, name: str, *, replace: bool = False) -> None:
        """Copies a file from the store if it is there and missing here; with ``replace`` even if it is here."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if (replace or not path.exists()) and (data := self.store.read(name)) is not None:
            atomic_write(path, data)

    def put(self, name: str) -> None:
        """Copies a file to the store if it exists."""
        path = self.folder / name
        if path.exists():
            self.store.write(name, path.read_bytes())

    def put_growing(self, name: str, *, ended: bool) -> None:
        """Replaces a file in the store when it has grown by the factor :data:`GROWTH`, or the command has ended.

        It is stored as a whole, so that the store has a prefix of one attempt, even if another attempt writes, too. The
        factor bounds the bytes sent to a multiple of the file.
        """
        path = self.folder / name
        size, stored = path.stat().st_size if path.exists() else 0, self._sizes.get(name, 0)
        if size < stored or size > stored * (1 if ended else GROWTH):
            self.put(name)
            self._sizes[name] = size


def run(options: argparse.Namespace) -> int:
    """Fetches inputs, runs the command and stores outputs; returns its status."""
    staging = Staging(ObjectFolder(options.store), scratch_folder(options))
    for name in options.needs:
        staging.fetch(name, replace=True)
    for name in options.gives:
        staging.fetch(name)
    if not all((staging.folder / name).exists() for name in options.gives):
        for name in options.grows:
            staging.fetch(name)
    process = subprocess.Popen(
        argv_of(tuple(argument.replace(HERE, str(staging.folder)) for argument in options.command))
    )
    status = None
    while status is None:
        with suppress(subprocess.TimeoutExpired):
            status = process.wait(POLL_SECONDS)
        for name in options.grows:
            staging.put_growing(name, ended=status is not None)
    if status == 0:
        for name in options.gives:
            staging.put(name)
    if 0 <= status < SIGNALLED:  # A command that failed by itself would fail again.
        remove_own(staging.folder, PURPOSE, ANY, whole=True)
    if status < 0:  # As the command ended, so that the task counts as killed.
        os.kill(os.getpid(), -status)
    return status


def scratch_folder(options: argparse.Namespace) -> Path:
    """The marked folder of a task on this machine; those of earlier runs of the task are removed.

    Raises:
        StorageError: it is somebody else's, or cannot be made.
    """
    above = Path(os.environ.get(SCRATCH) or tempfile.gettempdir())
    # Names of tasks are unique within a run only.
    task = hashlib.sha256(f"{options.store}\n{options.name}".encode()).hexdigest()[:16]
    folder = above / f"structgstream-{task}-{options.run}"
    for earlier in above.glob(f"structgstream-{task}-*"):
        if earlier != folder and (owner := owner_of(earlier)) is not None and owner.purpose == PURPOSE:
            remove_own(earlier, PURPOSE, ANY, whole=True)
    own_folder(folder, PURPOSE)
    return folder


def parsed(arguments: Sequence[str]) -> argparse.Namespace:
    """The command line, and the store's URL from :data:`STORE`; what follows ``--`` is the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--name", required=True, help="of the task")
    parser.add_argument("--run", default="", help="random name of the run")
    for flag, text in (
        ("needs", "file to fetch"),
        ("gives", "file to store when the command has ended well, and to fetch before if it is there"),
        ("grows", "file to store while it grows, and to fetch before if not all that is given is there"),
    ):
        parser.add_argument(f"--{flag}", action="append", default=[], metavar="NAME", help=text)
    parser.add_argument("command", nargs="+")
    options = parser.parse_args(arguments)
    options.store = os.environ.get(STORE)
    if not options.store:
        parser.error(f"the variable {STORE} has no URL of a store")
    return options


def main() -> int:
    """Runs; an error of the store is one sentence."""
    try:
        return run(parsed(sys.argv[1:]))
    except StructGStreamError as error:
        print(f"structgstream: {error}", file=sys.stderr, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
