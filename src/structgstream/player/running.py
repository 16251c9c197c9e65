# SPDX-License-Identifier: Apache-2.0
"""Runs the player's server on the loopback address, and opens a browser where there is a screen."""

import os
import socket
import sys
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
        app: what answers.
        port: 0 takes one that is free.
        on_start: called with the address once the port is ours.

    Raises:
        PlayerError: the port is taken, or may not be used.
    """
    with bound(port) as listening:
        config = uvicorn.Config(app, log_level="warning", access_log=False, timeout_graceful_shutdown=1)
        on_start(f"http://{ADDRESS}:{listening.getsockname()[1]}/")
        # uvicorn ends tidily on Ctrl-C and then passes it on.
        with suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listening])


def bound(port: int) -> socket.socket:
    """A socket that accepts connections from this machine already, so that a browser may be opened at once.

    Raises:
        PlayerError: the port is taken, or may not be used.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((ADDRESS, port))
        listening.listen()
    except (OSError, OverflowError) as error:
        listening.close()
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise PlayerError(
            f"Port {port} cannot be used ({reason}); choose another with --port, or leave it out."
        ) from None
    return listening


def open_browser(address: str, *, environ: Mapping[str, str] = os.environ) -> bool:
    """Opens ``address``; False where there is no screen, as a browser for terminals would take ours."""
    graphical = sys.platform in ("darwin", "win32") or any(
        environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    )
    return graphical and webbrowser.open(address)
