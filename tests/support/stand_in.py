# SPDX-License-Identifier: Apache-2.0
"""The commands of a parallel run without their work: the same words, files, locks and statuses, and bytes of a hash.

    python -m tests.support.stand_in reconstruct CAPTURE -o HEADER --frames 1 --resume --sound none
    python -m tests.support.stand_in track CAPTURE --init HEADER -o TRACK --groups 4 --frames 40
    python -m tests.support.stand_in fit-group CAPTURE --init HEADER --track TRACK --frames 4:8 -o SEGMENT
    python -m tests.support.stand_in join SEGMENT... -o OUT

Every frame takes ``STAND_IN_SECONDS`` (0.01) and adds a line to ``NAME.partial``, which is renamed when it is whole.
What is whole in a partial or damaged file is kept. It imports nothing of the package, so that it begins at once.
"""

import argparse
import fcntl
import hashlib
import os
import sys
import time
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

BYTES = 64


def line(*facts: object) -> str:
    """A frame: deterministic, with its own checksum at the end."""
    body = hashlib.sha256(repr(facts).encode()).hexdigest()[:BYTES]
    return f"{facts[0]} {facts[1]} {body} {hashlib.sha256(body.encode()).hexdigest()[:8]}\n"


def written(path: Path, lines: Iterable[str], *, seconds: float) -> None:
    """Writes the lines that are not there, slowly, and gives the file its name when all are."""
    wanted = list(lines)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.partial")
    source = path if path.exists() else partial
    found = source.read_text(errors="replace").splitlines(keepends=True) if source.exists() else []
    if path.exists() and found == wanted:
        return
    with partial.open("a+") as file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            sys.exit(f"Another process writes {partial}.")
        whole = next((i for i, (a, b) in enumerate(zip(found, wanted)) if a != b), min(len(found), len(wanted)))
        file.truncate(0)
        file.write("".join(wanted[:whole]))
        for text in wanted[whole:]:
            time.sleep(seconds)
            file.write(text)
            file.flush()
        os.fsync(file.fileno())
        partial.replace(path)


def starts(track: Path) -> list[int]:
    """The frames at which a group may begin by now."""
    for path in (track, track.with_name(f"{track.name}.partial")):
        try:
            lines = path.read_text().splitlines(keepends=True)
        except OSError:
            continue
        return [int(text.split()[1]) for text in lines if text.endswith("\n")]
    return []


def cut(path: Path, first: int) -> bytes:
    """A track with one start."""
    for each in (path, path.with_name(f"{path.name}.partial")):
        if each.exists():
            lines = each.read_text().splitlines(keepends=True)
            return "".join(text for text in lines if text.startswith(f"start {first} ")).encode()
    raise FileNotFoundError(path)


def track(options: argparse.Namespace, seconds: float) -> None:
    """A start for each group, and the groups."""
    borders = [*range(0, options.count, options.groups), options.count]
    text = "".join(f"{first}:{end}\n" for first, end in pairwise(borders))
    groups = options.output.with_name(f"{options.output.name}.groups")
    new = groups.with_name(f".{os.getpid()}-{groups.name}")
    new.write_text(text)
    new.replace(groups)
    header = options.init.read_text()
    written(options.output, (line("start", first, header) for first in borders[:-1]), seconds=seconds)


def segment(options: argparse.Namespace, seconds: float) -> None:
    """The frames of a group."""
    first, end = (int(word) for word in options.frames.split(":"))
    if first and first not in starts(options.track):
        sys.exit(f"{options.track} has no start at frame {first}.")
    header = options.init.read_text()
    written(options.output, (line("frame", i, header) for i in range(first, end)), seconds=seconds)


def join(options: argparse.Namespace) -> None:
    """All segments one after the other."""
    data = b"".join(Path(path).read_bytes() for path in options.words)
    temporary = options.output.with_name(f"{options.output.name}.partial")
    temporary.write_bytes(data)
    temporary.replace(options.output)


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("reconstruct", "track", "fit-group", "join"))
    parser.add_argument("words", nargs="+")
    parser.add_argument("-o", dest="output", type=Path, required=True)
    parser.add_argument("--init", type=Path)
    parser.add_argument("--track", type=Path)
    parser.add_argument("--sound")
    parser.add_argument("--frames", default="40")
    parser.add_argument("--groups", type=int, default=4)
    parser.add_argument("--fail", type=int, help="a segment that begins at this frame fails")
    for flag in ("--resume", "--overwrite"):
        parser.add_argument(flag, action="store_true")
    return parser.parse_args()


def main() -> None:
    """Does what was asked."""
    options, seconds = parsed(), float(os.environ.get("STAND_IN_SECONDS", "0.01"))
    if gpu := os.environ.get("CUDA_VISIBLE_DEVICES"):
        print("GPU", gpu)
    if options.command == "join":
        join(options)
    elif options.command == "track":
        options.count = int(options.frames)
        track(options, seconds)
    elif options.command == "reconstruct":
        written(options.output, [line("header", *options.words)], seconds=seconds)
    elif str(options.fail) == options.frames.partition(":")[0]:
        sys.exit("There was no power.")
    else:
        segment(options, seconds)


if __name__ == "__main__":
    main()
