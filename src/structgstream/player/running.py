# SPDX-License-Identifier: Apache-2.0
"""Runs the player's server on the loopback address, and opens a browser if there is a screen."""

import os
import socket
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import suppress

import uvicorn
from starlette.applications import Starlette

from structgstream.errors import PlayerError

ADDRESS = "127.0.0.1"


def run(app: Starlette, *, port: int = 0, on_start: Callable[[str], None]) -> None:
    """Serves ``app`` until Ctrl-C.

    Args:
        app: the application.
        port: 0 takes a free one.
        on_start: called with the address once the port is bound.

    Raises:
        PlayerError: the port is taken, or may not be used.
    """
    with bound(port) as listening:
        config = uvicorn.Config(app, log_level="warning", access_log=False, timeout_graceful_shutdown=1)
        on_start(f"http://{ADDRESS}:{listening.getsockname()[1]}/")
        # uvicorn shuts down on Ctrl-C and then raises it again.
        with suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listening])


def bound(port: int, *, address: str = ADDRESS) -> socket.socket:
    """A listening socket, on the loopback address unless told otherwise, so that a browser can be opened at once.

    Args:
        port: 0 takes a free one.
        address: IPv4 or IPv6 address of this machine.

    Raises:
        PlayerError: the port is taken, or may not be used.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    # Without the protocol asyncio leaves Nagle's algorithm on, and each further response of a connection waits 40 ms.
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((address, port))
        listening.listen()
    except (OSError, OverflowError) as error:
        listening.close()
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise PlayerError(
            f"Port {port} cannot be used ({reason}); choose another with --port, or leave it out."
        ) from None
    return listening


def open_browser(address: str, *, environ: Mapping[str, str] = os.environ) -> bool:
    """Opens ``address``; False without a screen, where a text browser would take over the terminal."""
    graphical = any(environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    return graphical and webbrowser.open(address)
