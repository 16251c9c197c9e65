# SPDX-License-Identifier: Apache-2.0
"""``structgstream archive``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError
from structgstream.cli.options import Flag, Folder, check_ending, parse_options
from structgstream.cli.progress import human_bytes, print_lines


@dataclass(frozen=True)
class Archive:
    """Turns a folder of segments into one stream file: the very bytes that reconstruct would have written as a file.

    The SHA-256 of every file is verified. A stream of which frames have left the window (--window) is refused.

    Example: structgstream archive ball -o ball.sgs
    """

    segments: tyro.conf.Positional[Folder]
    """The folder that reconstruct --sink segments has written."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write."""
    overwrite: Flag = False
    """Replace OUT.sgs when it exists."""


def main(arguments: list[str]) -> None:
    """Writes the file and prints its size."""
    options = parse_options(Archive, "archive", arguments=arguments)
    output = options.output
    check_ending(output, ".sgs", command="archive")
    if output.exists() and not options.overwrite:
        raise UsageError(f"{output} exists; replace it with --overwrite, or choose another name.")
    from structgstream.codec.segments.store import FolderStore
    from structgstream.codec.segments.stored_bytes import write_archive

    frames = write_archive(FolderStore(options.segments), output)
    what = "1 frame" if frames == 1 else f"{frames} frames"
    text = f"Wrote {output}: {what}, {human_bytes(output.stat().st_size)}"
    print_lines(Console(), text)
