# SPDX-License-Identifier: Apache-2.0
"""Runs a command whose files lie in an object store, as a program: ``python -m structgstream.parallel.staged``.

What the command needs is brought into a folder of this machine, and what it makes is taken to the store: a file that
grows (``--grows``) piece by piece while the command runs, others when it has ended well. The folder stays when the
command is killed, so that the next attempt on this machine goes on there.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from structgstream.errors import StructGStreamError
from structgstream.executors.task import words
from structgstream.parallel.object_folder import ObjectFolder

HERE = "{here}"
"""In a word of the command: the folder of this machine."""
SCRATCH = "STRUCTGSTREAM_SCRATCH"
"""The variable that names a folder for files of this machine; without it, that of temporary files."""
LOOK_SECONDS = 1.0


def growing_files(name: str) -> tuple[str, ...]:
    """Under which names a file lies while it grows and afterwards."""
    return f"{name}.partial", name


def pieces_of(name: str) -> str:
    """The folder of the store with the pieces of a file that grows, named by where they begin."""
    return f"{name}.pieces"


def assembled(store: ObjectFolder, name: str, *, have: int = 0) -> bytes:
    """What the store has of a growing file from byte ``have`` on."""
    data = b""
    for piece in store.names(pieces_of(name)):
        begins = int(piece.rsplit("/", 1)[-1])
        content = store.read(piece)
        if content is not None and begins <= have + len(data) < begins + len(content):
            data += content[have + len(data) - begins :]
    return data


class Staging:
    """The files of one task, here and in the store."""

    def __init__(self, store: ObjectFolder, folder: Path) -> None:
        self.store, self.folder = store, folder

    def bring(self, name: str) -> None:
        """Takes a file from the store, unless it is not there or an earlier attempt has left it here."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() and (data := self.store.read(name)) is not None:
            write_here(path, data)

    def bring_growing(self, name: str) -> None:
        """As :meth:`bring`, of a file that grows."""
        self.bring(name)
        partial, whole = (self.folder / each for each in growing_files(name))
        if not whole.exists() and not partial.exists() and (data := assembled(self.store, name)):
            write_here(partial, data)

    def take(self, name: str) -> None:
        """Takes a file to the store, if there is one."""
        path = self.folder / name
        if path.exists():
            self.store.write(name, path.read_bytes())

    def take_piece(self, name: str, have: int) -> int:
        """Takes what a growing file has from byte ``have`` on to the store; returns how much there is then."""
        for each in growing_files(name):
            try:
                with (self.folder / each).open("rb") as file:
                    file.seek(have)
                    data = file.read()
            except OSError:
                continue
            if data:
                self.store.write(f"{pieces_of(name)}/{have:015d}", data)
            return have + len(data)
        return have


def write_here(path: Path, data: bytes) -> None:
    """Writes a file in one step."""
    temporary = path.with_name(f".new-{os.getpid()}-{path.name}")
    temporary.write_bytes(data)
    temporary.replace(path)


def run(options: argparse.Namespace) -> int:
    """Brings, runs, and takes; returns the status of the command."""
    scratch = os.environ.get(SCRATCH) or tempfile.gettempdir()
    # Tasks of two runs may have one name, those of one run may not.
    unique = "".join(character if character.isalnum() else "-" for character in f"{options.store}-{options.name}")
    staging = Staging(ObjectFolder(options.store), Path(scratch) / f"structgstream-{unique}")
    for name in options.needs:
        staging.bring(name)
    for name in options.gives:
        staging.bring(name)
    for name in options.grows:
        staging.bring_growing(name)
    command = words(tuple(word.replace(HERE, str(staging.folder)) for word in options.command))
    process = subprocess.Popen(command)
    have = dict.fromkeys(options.grows, 0)
    while True:
        try:
            status = process.wait(LOOK_SECONDS)
        except subprocess.TimeoutExpired:
            status = None
        for name in options.grows:
            have[name] = staging.take_piece(name, have[name])
        for name in options.early:
            staging.take(name)
        if status is not None:
            break
    if status == 0:
        for name in (*options.grows, *options.gives):
            staging.take(name)
        shutil.rmtree(staging.folder, ignore_errors=True)
    if status < 0:  # As the command ended, so that the task counts as killed.
        os.kill(os.getpid(), -status)
    return status


def parsed(arguments: Sequence[str]) -> argparse.Namespace:
    """The command line; what follows ``--`` is the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", required=True, metavar="URL")
    parser.add_argument("--name", required=True, help="of the task")
    for flag, text in (
        ("needs", "file to bring"),
        ("gives", "file to take when the command has ended well, and to bring before if it is there"),
        ("early", "file to take as soon as it is there"),
        ("grows", "file to take while it grows"),
    ):
        parser.add_argument(f"--{flag}", action="append", default=[], metavar="NAME", help=text)
    parser.add_argument("command", nargs="+")
    return parser.parse_args(arguments)


def main() -> int:
    """Runs; an error of the store is one sentence."""
    try:
        return run(parsed(sys.argv[1:]))
    except StructGStreamError as error:
        print(f"structgstream: {error}", file=sys.stderr, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
