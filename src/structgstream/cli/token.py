# SPDX-License-Identifier: Apache-2.0
"""``structgstream token``."""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import Flag, parse_options

MAX_HOURS = 24 * 366


@dataclass(frozen=True)
class Token:
    """Makes an access token for a stream that structgstream serve --secret-file serves, and prints it.

    Example: structgstream token studio --hours 2 --secret-file secret

    Example: structgstream token studio --secret-file secret --address https://live.example.org/     (prints the link)
    """

    secret_file: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The server's secrets; the first one signs."""
    stream: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="STREAM", help_behavior_hint="")] = ""
    """Name of the stream, as the server lists it."""
    every: Flag = False
    """Make a token for all streams, their list and the metrics."""
    hours: float = 2.0
    """How long it is valid."""
    address: Annotated[str, tyro.conf.arg(metavar="URL", help_behavior_hint="")] = ""
    """The server's address, to print a link instead."""


def main(arguments: list[str]) -> None:
    """Prints a token."""
    options = parse_options(Token, "token", arguments=arguments)
    if not (math.isfinite(options.hours) and 0.0 < options.hours <= MAX_HOURS):
        raise UsageError(f"--hours {options.hours:g} is not above 0 and at most {MAX_HOURS}, a year.")
    if bool(options.stream) == options.every:
        raise UsageError("name one stream, or say --every.")
    from structgstream.serve.tokens import EVERY_STREAM, read_keys

    with usage_errors():
        expires = int(time.time() + options.hours * 3600.0)
        name = EVERY_STREAM if options.every else options.stream
        token = read_keys(options.secret_file).token(name, expires_unix_seconds=expires)
    if options.address:
        base = f"{options.address.rstrip('/')}/"
        token = f"{base if options.every else f'{base}streams/{name}/'}?token={token}"
    print(token)
