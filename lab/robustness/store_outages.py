# SPDX-License-Identifier: Apache-2.0
"""An object store that fails in many ways while a stream is copied to it (``reconstruct --publish``).

    python -m lab.robustness.store_outages --json outages.json
    python -m lab.robustness.store_outages --only slow "loses its files" --each 2 --seconds 2      (a trial)

An S3 on this machine's loopback address (moto) gets into trouble at a random frame and out of it again after a while.
What stands for the trainer writes prepared packets, which must never wait. A reader on another port, which has no
trouble, asks all the time for the manifest and everything that it names, with hashes.
"""

import argparse
import json
import logging
import random
import socket
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.machine import load_average, machine
from lab.robustness.stream_writers import OPTIONS, Sent, content, real_writer, repeated
from structgstream.codec.container.records import footer_offset
from structgstream.codec.reader import open_stream
from structgstream.codec.segments.manifest import MANIFEST, manifest_from_json
from structgstream.codec.segments.mirror import MirroredStore, MirrorOptions
from structgstream.codec.segments.store import CloudStore, FolderStore
from structgstream.codec.segments.stored_bytes import StoredBytes, read_manifest, write_archive
from structgstream.codec.sinks import resume_segments
from structgstream.errors import StreamError

FRAMES = 100
PACE_SECONDS = 0.1
SLOW_SECONDS = 1.0
POLL_SECONDS = 0.05
BUCKET = "outages"
KINDS = (
    "refuses connections", "answers 503", "answers 503 to every third", "denies access", "slow", "never answers",
    "breaks off", "stores and breaks off", "loses its files",
)  # fmt: skip
Respond = Callable[..., Any]
Application = Callable[[dict[str, Any], Respond], Iterable[bytes]]


@dataclass
class Row:
    """A kind of trouble, at several moments.

    Attributes:
        events: how often.
        equal: streams of which the store has the bytes in the end.
        reads_refused: when a reader did not find what a manifest names, or found something else.
        reads: how often it looked.
        longest_write_seconds: that a frame waited to be stored here, of all events.
        seconds_until_normal: from the end of the trouble until the store has a frame that was written after it.
        told: sentences about it.
    """

    what: str
    events: int = 0
    equal: int = 0
    reads: int = 0
    reads_refused: int = 0
    longest_write_seconds: list[float] = field(default_factory=list)
    seconds_until_normal: list[float] = field(default_factory=list)
    told: int = 0


class Troubled:
    """A WSGI application that passes requests on, unless it is in trouble."""

    def __init__(self, application: Application) -> None:
        self._application = application
        self._count = 0
        self.kind: str | None = None

    def __call__(self, environment: dict[str, Any], respond: Respond) -> Iterable[bytes]:
        """Answers, or not."""
        kind = self.kind
        self._count += 1
        if kind == "answers 503" or (kind == "answers 503 to every third" and self._count % 3 == 0):
            return _refused(environment, respond, "503 Slow Down", "SlowDown")
        # An S3 client tries again after a 503, which the thread that copies may then know nothing of.
        if kind in ("denies access", "loses its files"):
            return _refused(environment, respond, "403 Forbidden", "AccessDenied")
        if kind == "never answers":
            while self.kind == kind:
                time.sleep(0.05)
            return _broken_off(environment, respond)
        if kind == "breaks off":
            environment["wsgi.input"].read(int(environment.get("CONTENT_LENGTH") or 0) // 2)
            return _broken_off(environment, respond)
        if kind == "slow":
            time.sleep(SLOW_SECONDS)
        answer = self._application(environment, respond)
        return _broken_off(environment, respond) if kind == "stores and breaks off" else answer


def _refused(environment: dict[str, Any], respond: Respond, status: str, code: str) -> Iterable[bytes]:
    environment["wsgi.input"].read(int(environment.get("CONTENT_LENGTH") or 0))
    body = f"<Error><Code>{code}</Code><Message>Trouble.</Message></Error>".encode()
    respond(status, [("Content-Length", str(len(body))), ("Content-Type", "application/xml")])
    return [body]


def _broken_off(environment: dict[str, Any], respond: Respond) -> Iterable[bytes]:
    environment["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
    respond("500 Gone", [("Content-Length", "0")])
    return [b""]


class Service:
    """An application on a port, until :meth:`stop`; the port stays the same."""

    def __init__(self, application: Application) -> None:
        self._application, self._port = application, 0
        self.start()

    def start(self) -> None:
        """Listens."""
        from werkzeug.serving import make_server

        self._server = make_server("127.0.0.1", self._port, self._application, threaded=True)
        self._port = self._server.server_port
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def stop(self) -> None:
        """Refuses connections."""
        self._server.shutdown()
        self._server.server_close()

    def store(self, name: str) -> CloudStore:
        """A folder of the bucket, with the time-outs that the command has."""
        address = f"http://127.0.0.1:{self._port}"
        return CloudStore(
            f"s3://{BUCKET}/{name}", endpoint_url=address, key="nobody", secret="nothing", skip_instance_cache=True
        )


@contextmanager
def services() -> Iterator[tuple[Troubled, Service, Service]]:
    """An S3 that can get into trouble, its service, and one of the same objects without trouble."""
    import boto3
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app

    logging.getLogger("werkzeug").setLevel(logging.CRITICAL)
    application = DomainDispatcherApplication(create_backend_app)
    troubled = Troubled(application)
    one, other = Service(troubled), Service(application)
    client = boto3.client(
        "s3",
        endpoint_url=f"http://127.0.0.1:{other._port}",
        aws_access_key_id="nobody",
        aws_secret_access_key="nothing",
        region_name="us-east-1",
    )
    client.create_bucket(Bucket=BUCKET)
    try:
        yield troubled, one, other
    finally:
        one.stop()
        other.stop()


@dataclass
class Written:
    """How far what stands for the trainer is with ``count`` frames; :attr:`last` is the one that is there."""

    count: int
    last: int = -1

    @property
    def next(self) -> int:
        """The frame that is written next; the last one at the end."""
        return min(self.last + 1, self.count - 1)


class Reader(threading.Thread):
    """Reads all the time what the manifest names, and notes what it does not find; slow beside busy programs."""

    def __init__(self, store: CloudStore, whole: bytes) -> None:
        super().__init__(daemon=True)
        self._store, self._whole = store, whole
        self._ending = threading.Event()
        self.reads = self.refused = 0

    def run(self) -> None:
        """Until :meth:`end`."""
        while not self._ending.wait(0.1):
            if MANIFEST in self._store.names():
                self.reads += 1
                self.refused += not self._read()

    def _read(self) -> bool:
        try:
            manifest = read_manifest(self._store)
            found = StoredBytes(self._store, manifest, check=True)[:]
        except StreamError:
            return False
        return self._whole.startswith(found[: footer_offset(found)])

    def end(self) -> None:
        """Ends it."""
        self._ending.set()
        self.join()


def one_event(row: Row, sent: Sent, rng: random.Random, folder: Path, *, seconds: float, s3: Any) -> None:
    """A stream with trouble from a random frame on."""
    troubled, service, other = s3
    name = folder.name
    here = FolderStore(folder)
    here.prepare()
    told: list[str] = []
    mirror = MirroredStore(here, service.store(name), options=MirrorOptions(report=told.append))
    reader = Reader(other.store(name), sent.whole)
    reader.start()
    begin = rng.randrange(1, len(sent.packets) // 4)
    frames = Written(len(sent.packets))
    trouble = threading.Thread(target=_trouble, args=(row, troubled, service, other.store(name), seconds, frames))
    sink, _ = resume_segments(mirror, options=OPTIONS)
    sink.open(sent.header)
    longest = 0.0
    for packet in sent.packets:
        time.sleep(PACE_SECONDS)
        if packet.index == begin:
            trouble.start()
        began = time.monotonic()
        sink.write(packet)
        longest = max(longest, time.monotonic() - began)
        frames.last = packet.index
    sink.close()
    trouble.join()
    left = mirror.finish(wait_seconds=120.0)
    reader.end()
    row.events, row.told = row.events + 1, row.told + len(told)
    row.reads, row.reads_refused = row.reads + reader.reads, row.reads_refused + reader.refused
    row.longest_write_seconds.append(longest)
    write_archive(other.store(name), folder / "copy.sgs")
    row.equal += not left and (folder / "copy.sgs").read_bytes() == sent.whole == content(folder, beside=folder)


def _trouble(
    row: Row, troubled: Troubled, service: Service, there: CloudStore, seconds: float, frames: Written
) -> None:
    """Gets the store into trouble and out of it, and waits until it has a frame that was written after it."""
    if row.what == "refuses connections":
        service.stop()
    else:
        troubled.kind = row.what
    time.sleep(seconds)
    if row.what == "loses its files":
        for name in there.names():
            there.delete(name)
    if row.what == "refuses connections":
        service.start()
    troubled.kind = None
    ended, wanted = time.monotonic(), frames.next
    while _edge(there) < wanted and time.monotonic() - ended < 120.0:
        time.sleep(POLL_SECONDS)
    row.seconds_until_normal.append(time.monotonic() - ended)


def _edge(store: CloudStore) -> int:
    with suppress(StreamError):
        return manifest_from_json(store.get(MANIFEST), name=MANIFEST).edge.frame
    return -1


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    heads = (
        "the store",
        "events",
        "equal bytes",
        "reads refused",
        "longest write, s: median, most",
        "s until normal: median, most",
    )
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row in rows:
        cells = (
            row.what,
            row.events,
            row.equal,
            f"{row.reads_refused} of {row.reads}",
            *map(_median_most, (row.longest_write_seconds, row.seconds_until_normal)),
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def _median_most(values: list[float]) -> str:
    return f"{statistics.median(values):.2f}, {max(values):.2f}"


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=KINDS, metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--each", type=int, default=5, help="events of each kind")
    parser.add_argument("--seconds", type=float, default=4.0, help="of an event")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser.parse_args()


def main() -> None:
    """Measures, and prints a row when it is done."""
    options = parsed()
    rows: list[Row] = []
    before = load_average()
    with tempfile.TemporaryDirectory(prefix="outages-") as name, services() as s3:
        folder = Path(name)
        real_writer(8)(folder / "clip", lambda frame: None)
        sent = repeated(open_stream(folder / "clip"), frames=FRAMES)
        for what in options.only:
            row, rng = Row(what), random.Random(f"{what} {options.seed}")
            rows.append(row)
            for number in range(options.each):
                place = folder / f"{what.replace(' ', '-')}-{number}"
                one_event(row, sent, rng, place, seconds=options.seconds, s3=s3)
            print(table([row]).splitlines()[-1], flush=True)
    print(table(rows))
    if options.json:
        load = {"before": before, "after": load_average()}
        result = {"rows": [asdict(row) for row in rows], "machine": machine(), "load_average": load}
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
