# SPDX-License-Identifier: Apache-2.0
"""``structgstream play``."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError
from structgstream.cli.options import Flag, parse_options
from structgstream.cli.options import StreamFile as StreamPath
from structgstream.cli.progress import print_lines
from structgstream.errors import MissingExtraError

if TYPE_CHECKING:
    from structgstream.serve.play import Truth
    from structgstream.serve.stream_file import StreamFile

POLL_SECONDS = 0.5


@dataclass(frozen=True)
class Play:
    """Shows a stream in the browser, from any angle.

    Serves on this machine's loopback address only, until Ctrl-C. If reconstruct is still writing the file, each frame
    appears when it is written.

    Example: structgstream play ball.sgs --capture basketball

    Example: structgstream play ball.sgs --wait     (while reconstruct works on frame 0 in another terminal)
    """

    stream: tyro.conf.Positional[StreamPath]
    """The stream file."""
    capture: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """The capture that it was made from, to compare with the cameras' pictures."""
    port: Annotated[int, tyro.conf.arg(help_behavior_hint="")] = 0
    """Port to listen on. Default: one that is free."""
    browser: Flag = True
    """Do not open a browser."""
    wait: Flag = False
    """Wait until the file exists: it is created when frame 0 is done."""


def main(arguments: list[str]) -> None:
    """Serves until Ctrl-C."""
    options = parse_options(Play, "play", arguments=arguments)
    if not 0 <= options.port < 65536:
        raise UsageError(f"--port {options.port} is not one of 0 to 65535.")
    try:
        from structgstream.serve.listening import open_browser, run, server
        from structgstream.serve.play import application
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or "starlette", "serve") from None
    from structgstream.serve.stream_file import StreamFile

    stream = StreamFile(options.stream)
    if options.wait:
        _wait_for(stream)
    stream.check()
    truth = None if options.capture is None else _truth(options.stream, options.capture)
    growing = not stream.state()[1]

    def announce(address: str) -> None:
        lines = [f"{options.stream} plays at {address} (Ctrl-C ends)."]
        if growing:
            lines.append("The file has no end yet: frames appear as they are written.")
        if options.browser and not open_browser(address):
            lines.append("There is no screen to open a browser on: open the address yourself.")
        print_lines(Console(), *lines)

    run(server(application(stream, truth=truth)), port=options.port, on_start=announce)


def _wait_for(stream: "StreamFile") -> None:
    if not stream.has_header():
        text = f"Waiting for {stream.path}, which comes when frame 0 is done (Ctrl-C ends)."
        print_lines(Console(stderr=True), text)
    while not stream.has_header():
        time.sleep(POLL_SECONDS)


def _truth(stream: Path, scene: Path) -> "Truth":
    """The capture's pictures, by the cameras that it shares with the stream.

    Raises:
        CaptureError: it is not the capture that the stream was made from.
    """
    from structgstream.codec.reader import open_stream
    from structgstream.evaluation.facts import check_same_rig
    from structgstream.evaluation.recording import capture_of
    from structgstream.serve.play import Truth

    with open_stream(stream, by_index=True) as reader:
        header = reader.header
    source = capture_of(header, scene, frames=None)
    shared = tuple(name for name in header.rig if name in source.rig.cameras)
    check_same_rig(header, source, shared or tuple(header.rig)[:1])
    return Truth(source, shared)
