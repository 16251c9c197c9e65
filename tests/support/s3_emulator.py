# SPDX-License-Identifier: Apache-2.0
"""An S3 on this machine's loopback address, which can be switched off and on."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

BUCKET = "streams"


class Emulator:
    """A server with one bucket. What it holds survives :meth:`stop` and :meth:`start`."""

    def __init__(self) -> None:
        self._server: Any = None
        self._port = 0
        self.start()

    @property
    def options(self) -> dict[str, Any]:
        """For ``CloudStore``."""
        return {
            "endpoint_url": f"http://127.0.0.1:{self._port}",
            "key": "nobody",
            "secret": "nothing",
            "config_kwargs": {"retries": {"max_attempts": 0}, "connect_timeout": 2, "read_timeout": 2},
            "skip_instance_cache": True,
        }

    def start(self) -> None:
        """Listen, on the same port as before."""
        from moto.server import ThreadedMotoServer

        self._server = ThreadedMotoServer(ip_address="127.0.0.1", port=self._port, verbose=False)
        self._server.start()
        self._port = self._server.get_host_and_port()[1]

    def stop(self) -> None:
        """Refuse connections."""
        self._server.stop()


@contextmanager
def emulator() -> Iterator[Emulator]:
    """A running one with an empty bucket."""
    pytest.importorskip("s3fs", reason="s3fs, of the extra cloud, is not installed")
    pytest.importorskip("moto.server", reason="moto, of the extra dev, is not installed")
    import s3fs

    server = Emulator()
    try:
        files = s3fs.S3FileSystem(**server.options)
        files.mkdir(BUCKET)
        yield server
        server_files = s3fs.S3FileSystem(**server.options)
        server_files.rm(BUCKET, recursive=True)
    finally:
        server.stop()
