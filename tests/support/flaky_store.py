# SPDX-License-Identifier: Apache-2.0
"""An S3 on this machine's loopback address that refuses every n-th request."""

import itertools
import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any
from unittest.mock import patch

BUCKET = "parts"
Respond = Callable[..., Any]


class Refusing:
    """A WSGI application that answers 503 to every ``every``-th request, and passes the others on."""

    def __init__(self, application: Callable[[dict[str, Any], Respond], Iterable[bytes]], every: int) -> None:
        self._application, self.every = application, every
        self._count = itertools.count(1)
        self.requests = self.refused = 0

    def __call__(self, environment: dict[str, Any], respond: Respond) -> Iterable[bytes]:
        """Answers."""
        self.requests = number = next(self._count)
        if self.every and number % self.every == 0:
            self.refused += 1
            environment["wsgi.input"].read(int(environment.get("CONTENT_LENGTH") or 0))
            respond("503 Slow Down", [("Content-Length", "0")])
            return [b""]
        return self._application(environment, respond)


@contextmanager
def flaky_store(every: int) -> Iterator[tuple[str, Refusing]]:
    """The URL of a bucket, which this process and those that it begins find by their environment."""
    import s3fs
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # Not a line for each request.
    application = Refusing(DomainDispatcherApplication(create_backend_app), every=0)
    server = make_server("127.0.0.1", 0, application, threaded=True)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    variables = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}",
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_MAX_ATTEMPTS": "1",  # What is tried again is tried by us.
    }
    try:
        with patch.dict(os.environ, variables):
            s3fs.S3FileSystem.clear_instance_cache()  # Those of an earlier server go to its address.
            with suppress(FileExistsError):  # What moto holds outlives its server.
                s3fs.S3FileSystem().mkdir(BUCKET)
            application.every = every
            yield f"s3://{BUCKET}/run", application
    finally:
        server.shutdown()
