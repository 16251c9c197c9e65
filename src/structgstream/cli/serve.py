# SPDX-License-Identifier: Apache-2.0
"""``structgstream serve``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import Flag, Folder, parse_options
from structgstream.cli.progress import print_lines
from structgstream.errors import MissingExtraError

MAX_CONNECTIONS = 100_000

Words = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]", help_behavior_hint="")]


@dataclass(frozen=True)
class Serve:
    """Serves the streams of a folder to viewers, live ones while they are reconstructed.

    Listens on the loopback address by default, until Ctrl-C or SIGTERM. Streams are folders of segments and files that
    end in .sgs; FOLDER itself may hold the segments of one. For the public, put a reverse proxy in front of it: it adds
    TLS, a cache, and limits on rates, connections and slow clients, which this server does not have (docs/serve.md).

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
    secret_file: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
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
    """Connections from which on requests are answered with 503."""


def main(arguments: list[str]) -> None:
    """Serves until Ctrl-C."""
    options = parse_options(Serve, "serve", arguments=arguments)
    if not 0 <= options.port < 65536:
        raise UsageError(f"--port {options.port} is not one of 0 to 65535.")
    try:
        from structgstream.serve.app import ServerSettings, application
        from structgstream.serve.listening import (
            accepted_hosts,
            checked_address,
            checked_origins,
            checked_proxies,
            run,
            server,
        )
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or "starlette", "serve") from None
    from structgstream.serve.tokens import read_keys

    if not 1 <= options.connections <= MAX_CONNECTIONS:
        raise UsageError(f"--connections {options.connections} is not one of 1 to {MAX_CONNECTIONS}.")
    with usage_errors():
        address = checked_address(options.host, tokens=options.secret_file is not None, public=options.public)
        settings = ServerSettings(
            folder=options.folder,
            keys=None if options.secret_file is None else read_keys(options.secret_file),
            origins=checked_origins(options.allow_origin),
            hosts=accepted_hosts(address, options.server_name),
        )
        proxies = checked_proxies(options.proxy)

    def announce(url: str) -> None:
        lines = [f"The streams of {options.folder} are at {url} (Ctrl-C ends)."]
        if options.secret_file is not None:
            lines.append(f"Viewers need a token: structgstream token NAME --secret-file {options.secret_file}")
        elif options.public:
            lines.append("Everyone who reaches this machine sees all of them.")
        print_lines(Console(), *lines)

    prepared = server(application(settings), proxies=proxies, connections=options.connections)
    run(prepared, address=address, port=options.port, on_start=announce)
