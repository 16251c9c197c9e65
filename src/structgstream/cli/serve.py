# SPDX-License-Identifier: Apache-2.0
"""Commands that show streams: ``serve``, ``play`` and ``token``."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import Flag, Folder, parse_options, shown_as
from structgstream.cli.options import StreamFile as StreamPath
from structgstream.cli.progress import print_lines
from structgstream.errors import MissingExtraError

if TYPE_CHECKING:
    from structgstream.serve.pages import StreamFile
    from structgstream.serve.play import Truth

MAX_CONNECTIONS = 100_000

Words = Annotated[tuple[str, ...], shown_as("NAME [NAME ...]")]


@dataclass(frozen=True)
class Serve:
    """Serves the streams of a folder to viewers, live ones while they are reconstructed.

    Listens on the loopback address by default, until Ctrl-C or SIGTERM. Streams are folders of segments and files that
    end in .sgs; FOLDER itself may hold the segments of one. For the public, put a reverse proxy in front of it: it adds
    TLS, a cache, and limits on rates, on slow clients and on the connections of each, which this server does not have
    (docs/serve.md).

    Example: structgstream serve streams

    Example: structgstream serve streams --host 0.0.0.0 --secret-file secret      (viewers need a token)

    Example: structgstream serve streams --proxy 127.0.0.1 --server-name live.example.org --secret-file secret
    """

    folder: tyro.conf.Positional[Folder]
    """Holds the streams."""
    host: str = "127.0.0.1"
    """IP address to listen on. Others than the loopback address need --secret-file or --public."""
    port: int = 8080
    """Port to listen on; 0 takes one that is free."""
    secret_file: Annotated[Path | None, shown_as("FILE")] = None
    """Secrets that access tokens are signed with, one a line; see structgstream token. Without, no token is needed."""
    public: Flag = False
    """Listen on any address without tokens: everyone who reaches this machine sees all streams of the folder."""
    allow_origin: Words = ()
    """Origins whose pages may read, as https://example.org, or *. Default: only pages of this server."""
    server_name: Words = ()
    """Names under which the server is asked, besides those of this machine, as behind a proxy."""
    proxy: Words = ()
    """Addresses or networks of reverse proxies, whose X-Forwarded-For and X-Forwarded-Proto are trusted."""
    connections: int = 1000
    """Largest number of connections; while there are more, requests are answered with 503."""


@contextmanager
def _extra_of(port: int) -> Iterator[None]:
    """Converts what an import in the block lacks to the extra that has it, after a check of the port."""
    if not 0 <= port < 65536:
        raise UsageError(f"--port {port} is not one of 0 to 65535.")
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or "starlette", "serve") from None


def main(arguments: list[str]) -> None:
    """Serves until Ctrl-C."""
    options = parse_options(Serve, "serve", arguments=arguments)
    with _extra_of(options.port):
        from structgstream.serve import listening
        from structgstream.serve.app import ServerSettings, application
    from structgstream.serve.access import read_keys

    if not 1 <= options.connections <= MAX_CONNECTIONS:
        raise UsageError(f"--connections {options.connections} is not one of 1 to {MAX_CONNECTIONS}.")
    with usage_errors():
        address = listening.checked_address(options.host, tokens=options.secret_file is not None, public=options.public)
        settings = ServerSettings(
            folder=options.folder,
            keys=None if options.secret_file is None else read_keys(options.secret_file),
            origins=listening.checked_origins(options.allow_origin),
            hosts=listening.accepted_hosts(address, options.server_name),
        )
        proxies = listening.checked_proxies(options.proxy)

    def announce(url: str) -> None:
        lines = [f"The streams of {options.folder} are at {url} (Ctrl-C ends)."]
        if options.secret_file is not None:
            lines.append(f"Viewers need a token: structgstream token NAME --secret-file {options.secret_file}")
        elif options.public:
            lines.append("Everyone who reaches this machine sees all of them.")
        print_lines(Console(), *lines)

    prepared = listening.server(application(settings), proxies=proxies, connections=options.connections)
    listening.run(prepared, address=address, port=options.port, on_start=announce)


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
    capture: Annotated[Path | None, shown_as("FOLDER")] = None
    """The capture that it was made from, to compare with the cameras' pictures."""
    port: Annotated[int, shown_as()] = 0
    """Port to listen on. Default: one that is free."""
    browser: Flag = True
    """Do not open a browser."""
    wait: Flag = False
    """Wait until the file exists: it is created when frame 0 is done."""


def play(arguments: list[str]) -> None:
    """Serves until Ctrl-C."""
    options = parse_options(Play, "play", arguments=arguments)
    with _extra_of(options.port):
        from structgstream.serve.listening import open_browser, run, server
        from structgstream.serve.play import application
    from structgstream.serve.pages import StreamFile

    stream = StreamFile(options.stream)
    if options.wait:
        _wait_for(stream)
    stream.check()
    truth = None if options.capture is None else _truth(options.stream, options.capture)
    growing = not stream.state()["complete"]

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
    """The capture's pictures, by the cameras that it shares with the stream."""
    from structgstream.codec.reader import open_stream
    from structgstream.evaluation.recording import capture_of, check_same_rig
    from structgstream.serve.play import Truth

    with open_stream(stream, by_index=True) as reader:
        header = reader.header
    source = capture_of(header, scene, frames=None)
    shared = tuple(name for name in header.rig if name in source.rig.cameras)
    check_same_rig(header, source, shared or tuple(header.rig)[:1])
    return Truth(source, shared)


MAX_HOURS = 24 * 366


@dataclass(frozen=True)
class Token:
    """Makes an access token for a stream that structgstream serve --secret-file serves, and prints it.

    Example: structgstream token studio --hours 2 --secret-file secret

    Example: structgstream token studio --secret-file secret --address https://live.example.org/     (prints the link)
    """

    secret_file: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The server's secrets; the first one signs."""
    stream: Annotated[tyro.conf.Positional[str], shown_as("STREAM")] = ""
    """Name of the stream, as the server lists it."""
    every: Flag = False
    """Make a token for all streams, their list and the metrics."""
    hours: float = 2.0
    """How long it is valid."""
    address: Annotated[str, shown_as("URL")] = ""
    """The server's address, to print a link instead."""


def token(arguments: list[str]) -> None:
    """Prints a token."""
    options = parse_options(Token, "token", arguments=arguments)
    if not (math.isfinite(options.hours) and 0.0 < options.hours <= MAX_HOURS):
        raise UsageError(f"--hours {options.hours:g} is not above 0 and at most {MAX_HOURS}, a year.")
    if bool(options.stream) == options.every:
        raise UsageError("name one stream, or say --every.")
    from structgstream.serve.access import EVERY_STREAM, read_keys

    with usage_errors():
        expires = int(time.time() + options.hours * 3600.0)
        name = EVERY_STREAM if options.every else options.stream
        token = read_keys(options.secret_file).token(name, expires_unix_seconds=expires)
    if options.address:
        base = f"{options.address.rstrip('/')}/"
        token = f"{base if options.every else f'{base}streams/{name}/'}?token={token}"
    print(token)
