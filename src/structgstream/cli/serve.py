# SPDX-License-Identifier: Apache-2.0
"""``structgstream serve``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import Folder, parse_options
from structgstream.cli.plain_text import say
from structgstream.errors import MissingExtraError

if TYPE_CHECKING:
    from structgstream.server.settings import ServerSettings

Words = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]", help_behavior_hint="")]


@dataclass(frozen=True)
class Serve:
    """Serves the streams of a folder to viewers, live ones while they are made.

    Listens on this machine's loopback address unless told otherwise, until Ctrl-C or SIGTERM. Streams are folders of
    segments and files that end in .sgs; FOLDER itself may hold the segments of one.

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
    public: bool = False
    """Listen on any address without tokens: everyone who reaches this machine sees all streams of the folder."""
    allow_origin: Words = ()
    """Origins whose pages may read, as https://example.org, or *. Default: only pages of this server."""
    server_name: Words = ()
    """Names under which the server is asked, besides those of this machine, as behind a proxy."""
    proxy: Words = ()
    """Addresses or networks of reverse proxies, whose X-Forwarded-For and X-Forwarded-Proto are believed."""
    previews: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """Do not render preview pictures; those that exist as files are shown."""
    requests_per_second: float = 50.0
    """Requests a second of an address, on average; up to four seconds' worth at once."""
    connections: int = 1000
    """Connections of all addresses."""
    connections_per_address: int = 100
    """Connections of one address."""


def main(arguments: list[str]) -> None:
    """Serves until Ctrl-C."""
    options = parse_options(Serve, "serve", arguments=arguments)
    if not 0 <= options.port < 65536:
        raise UsageError(f"--port {options.port} is not one of 0 to 65535.")
    try:
        from structgstream.server.arenas import use_one_arena
        from structgstream.server.listening import checked_address, run
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or "starlette", "serve") from None

    with usage_errors():
        address = checked_address(options.host, guarded=options.secret_file is not None, public=options.public)
        settings = _settings(options, address)

    def tell(url: str) -> None:
        lines = [f"The streams of {options.folder} are at {url} (Ctrl-C ends)."]
        if options.secret_file is not None:
            lines.append(f"Viewers need a token: structgstream token NAME --secret-file {options.secret_file}")
        elif options.public:
            lines.append("Everyone who reaches this machine sees all of them.")
        say(Console(), *lines)

    use_one_arena()
    run(settings, address=address, port=options.port, on_start=tell)


def _settings(options: Serve, address: str) -> "ServerSettings":
    """What the options say.

    Raises:
        ConfigError: one has an invalid value.
    """
    from structgstream.server.listening import accepted_hosts, checked_limits, checked_origins, checked_proxies
    from structgstream.server.settings import ServerSettings
    from structgstream.server.tokens import read_keys

    return ServerSettings(
        folder=options.folder,
        keys=None if options.secret_file is None else read_keys(options.secret_file),
        origins=checked_origins(options.allow_origin),
        hosts=accepted_hosts(address, options.server_name),
        proxies=checked_proxies(options.proxy),
        previews=options.previews,
        limits=checked_limits(options.requests_per_second, options.connections, options.connections_per_address),
    )
