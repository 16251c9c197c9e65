# SPDX-License-Identifier: Apache-2.0
"""The commands of a parallel run without their work: the same words, files, locks and statuses, and bytes of a hash.

    python -m tests.support.stand_in reconstruct CAPTURE -o HEADER --frames 1 --resume --sound none
    python -m tests.support.stand_in track CAPTURE --init HEADER -o TRACK --groups 4 --frames 40
    python -m tests.support.stand_in fit-group CAPTURE --init HEADER --track TRACK --frames 4:8 -o SEGMENT
    python -m tests.support.stand_in join SEGMENT... -o OUT

Every frame takes ``STAND_IN_SECONDS`` (0.01) and adds a line to ``NAME.partial``, which is renamed when it is whole; a
track has records, which the driver reads. What is whole in a partial or damaged file is kept. It imports nothing of the
package, so that it begins at once.
"""

import argparse
import fcntl
import hashlib
import json
import os
import struct
import sys
import time
import zlib
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path


def line(*facts: object) -> bytes:
    """A frame: deterministic, with its own checksum at the end."""
    body = hashlib.sha256(repr(facts).encode()).hexdigest()
    return f"{facts[0]} {facts[1]} {body} {hashlib.sha256(body.encode()).hexdigest()[:8]}\n".encode()


def record(kind: int, payload: bytes) -> bytes:
    """A record of a track."""
    head = struct.pack("<BBHI", kind, 0, 0, len(payload))
    return head + payload + struct.pack("<I", zlib.crc32(head + payload))


def start(frame: int) -> bytes:
    """The record of a start at which nothing has moved."""
    return record(2, struct.pack("<III", frame, 0, 1) + zlib.compress(bytes(2), 9))


def written(path: Path, pieces: Iterable[bytes], *, seconds: float) -> None:
    """Writes the pieces that are not there, slowly, and gives the file its name when all are."""
    wanted = list(pieces)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.partial")
    source = path if path.exists() else partial
    found = source.read_bytes() if source.exists() else b""
    if path.exists() and found == b"".join(wanted):
        return
    with partial.open("ab") as file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            sys.exit(f"Another process writes {partial}.")
        file.truncate(0)
        at = 0
        for piece in wanted:
            is_there = found[at : at + len(piece)] == piece
            at = at + len(piece) if is_there else len(found)
            if not is_there:
                time.sleep(seconds)
            file.write(piece)
            file.flush()
        os.fsync(file.fileno())
        partial.replace(path)


def track(options: argparse.Namespace, seconds: float) -> None:
    """A start for each group but the first, and the groups."""
    borders = [*range(0, options.count, options.groups), options.count]
    text = "".join(f"{first}:{end}\n" for first, end in pairwise(borders))
    groups = options.output.with_name(f"{options.output.name}.groups")
    new = groups.with_name(f".{os.getpid()}-{groups.name}")
    new.write_text(text)
    new.replace(groups)
    head = {"header": options.init.read_text(), "capture": "", "step": 1.0, "primitives": 0, "every": 1, "config": {}}
    begin = struct.pack("<8sHH", b"\x89SGT\r\n\x1a\n", 1, 0) + record(1, json.dumps(head).encode())
    written(options.output, [begin, *map(start, borders[1:-1])], seconds=seconds)


def segment(options: argparse.Namespace, seconds: float) -> None:
    """The frames of a group."""
    first, end = (int(word) for word in options.frames.split(":"))
    paths = (options.track, options.track.with_name(f"{options.track.name}.partial"))
    if first and not any(path.exists() and start(first) in path.read_bytes() for path in paths):
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
