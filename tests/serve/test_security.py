# SPDX-License-Identifier: Apache-2.0
"""What a hostile client tries, against the running server."""

import os
import socket
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest

from structgstream.serve import streams
from structgstream.serve.app import ServerSettings
from tests.support.properties import thinned
from tests.support.segment_folders import GrowingFolder
from tests.support.serving import Served, hosted
from tests.support.streams import small_stream

STREAM = small_stream(7)
SECRET = b"root:x:0:0 what no client may see"


def made(place: Path) -> Path:
    """A folder that is served, beside one that is not."""
    (place / "outside").mkdir()
    (place / "outside" / "stream.sgs").write_bytes(SECRET)
    (place / "outside" / "manifest.json").write_bytes(SECRET)
    served = place / "streams"
    GrowingFolder(served / "studio", STREAM).write_all()
    (served / "ball.sgs").write_bytes(STREAM)
    return served


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server for those who change nothing in its folder."""
    with hosted(ServerSettings(made(tmp_path_factory.mktemp("it")))) as running:
        yield running


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return made(tmp_path)


@pytest.fixture
def own_server(folder: Path) -> Iterator[Served]:
    with hosted(ServerSettings(folder)) as running:
        yield running


def get(server: Served, address: str) -> bytes:
    """What comes back for an address, just as it is written."""
    return answer_to(server, f"GET {address} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())


def answer_to(server: Served, sent: bytes) -> bytes:
    """What comes back to bytes that are no HTTP client's, until the server closes."""
    with server.connected() as connection:
        connection.sendall(sent)
        return all_of(connection)


def all_of(connection: socket.socket) -> bytes:
    pieces = []
    try:
        while piece := connection.recv(65536):
            pieces.append(piece)
    except ConnectionResetError:
        pass
    return b"".join(pieces)


def status_of(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


UP = ["..", "%2e%2e", "%2E.", "%252e%252e", "%c0%ae%c0%ae", "..%00", "..%5c", "..;"]
SLASHES = ["/", "%2f", "%252f", "%5c", "\\", "//"]


@pytest.mark.parametrize("start", ["", "/streams", "/streams/studio", "/streams/ball.sgs"])
def test_no_path_leads_out(server: Served, start: str) -> None:
    for up, slash, depth in thinned([*product(UP, SLASHES, (1, 2, 5))]):
        path = f"{start}/{slash.join([up] * depth)}{slash}outside{slash}stream.sgs"
        answer = get(server, path)
        assert status_of(answer) in (400, 404), path
        assert SECRET not in answer


@pytest.mark.parametrize(
    "path",
    [
        "/streams/studio/manifest.json%00.png",
        "/streams/studio%00/manifest.json",
        "/streams/studio/manifest%2ejson",
        "/streams/studio%2fmanifest.json",
        "/streams\\studio\\manifest.json",
        "/streams/studio/./manifest.json",
        "/streams/studio/../studio/manifest.json",
        "/streams/./studio/manifest.json",
        "//streams/studio/manifest.json",
        "/streams//studio/manifest.json",
        "/streams/studio/manifest.json/",
        "/streams/STUDIO/manifest.json",
        "/streams/studio;x/manifest.json",
        "/streams/~studio/manifest.json",
        "/streams/con/manifest.json",
        "streams/studio/manifest.json",
        "*",
    ],
)
def test_an_address_is_written_in_one_way(server: Served, path: str) -> None:
    assert server.ask("/streams/studio/manifest.json").status == 200
    assert status_of(get(server, path)) in (400, 404)


def test_no_link_is_followed(own_server: Served, folder: Path) -> None:
    outside = folder.parent / "outside"
    part = next((folder / "studio").glob("part-*"))
    (folder / "link.sgs").symlink_to(outside / "stream.sgs")
    (folder / "linked").symlink_to(outside)
    (folder / "inner").symlink_to(folder / "studio")
    planted = "part-00000099-0123456789abcdef.sgs"
    (folder / "studio" / planted).symlink_to(outside / "stream.sgs")
    (folder / "studio" / "preview.png").symlink_to(outside / "stream.sgs")
    (folder / "half").mkdir()
    (folder / "half" / "manifest.json").symlink_to(outside / "manifest.json")
    time.sleep(1.1)  # The folder is looked at again after a second.
    for path in (
        "link.sgs/stream.sgs", "linked/manifest.json", "inner/manifest.json", f"inner/{part.name}",
        f"studio/{planted}", "studio/preview", "half/manifest.json",
    ):  # fmt: skip
        answer = own_server.ask(f"/streams/{path}")
        assert answer.status == 404, path
        assert SECRET not in answer.body
    assert own_server.ask(f"/streams/studio/{part.name}").status == 200
    # A stream that was found and is then exchanged for a link.
    (folder / "ball.sgs").unlink()
    (folder / "ball.sgs").symlink_to(outside / "stream.sgs")
    assert own_server.ask("/streams/ball.sgs/stream.sgs").status == 404


def test_queries_have_a_sequence_number_or_what_does_not_matter(server: Served) -> None:
    numbers = ("", "-1", "1.0", "1e3", "x", "%31%0a", "1_0", "9" * 17, "%D9%A1", "\u0663")
    queries = [(f"after={number}", 400) for number in numbers]
    others = ("<script>alert(1)</script>", "after=0&x=%00", "after=9&x=%ff", "&" * 9000)
    for query, status in [*queries, *((query, 200) for query in others)]:
        answer = get(server, f"/streams/studio/manifest.json?{query}")
        assert status_of(answer) == status, query
        assert b"<script>" not in answer


def test_long_headers_are_refused(server: Served) -> None:
    many = "".join(f"X-{i}: {'y' * 100}\r\n" for i in range(4000))
    answer = answer_to(server, f"GET /health HTTP/1.1\r\nHost: localhost\r\n{many}\r\n".encode())
    # Closing a connection that still sends resets it, which may take the answer with it.
    assert not answer or status_of(answer) in (400, 431)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "TRACE", "CONNECT", "PROPFIND", "OPTIONS"])
def test_nothing_can_be_changed(server: Served, method: str) -> None:
    answer = server.ask("/streams/studio/manifest.json", method=method)
    assert (answer.status, {*answer.headers["allow"].split(", ")}) == (405, {"GET", "HEAD"})


@pytest.mark.parametrize("host", ["evil.example:80", "127.0.0.1.evil.example", "localhost.evil", "["])
def test_another_name_for_this_machine_is_refused(server: Served, host: str) -> None:
    for path in ("/", "/streams/studio/manifest.json", "/streams/ball.sgs/stream.sgs", "/metrics"):
        answer = server.ask(path, Host=host)
        assert answer.status == 400
        assert STREAM[:8] not in answer.body


def test_names_that_are_given_are_welcome(folder: Path) -> None:
    with hosted(ServerSettings(folder, hosts=("live.example.org",))) as server:
        assert server.ask("/health", Host="live.example.org:443").status == 200
        assert server.ask("/health", Host="localhost").status == 400


def test_pages_of_other_origins_may_not_read(server: Served) -> None:
    for path in ("/", "/streams/studio/manifest.json", "/streams/ball.sgs/stream.sgs", "/nothing"):
        headers = server.ask(path, Origin="https://evil.example").headers
        assert "access-control-allow-origin" not in headers
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
    assert server.ask("/streams/studio/manifest.json").headers["cross-origin-resource-policy"] == "same-origin"


def test_pages_of_the_named_origins_may_read(folder: Path) -> None:
    origin = "https://show.example.org"
    with hosted(ServerSettings(folder, origins=(origin,))) as server:
        address = "/streams/studio/manifest.json"
        answer = server.ask(address, Origin=origin)
        assert answer.headers["access-control-allow-origin"] == origin
        assert "Origin" in answer.headers["vary"]
        assert "ETag" in answer.headers["access-control-expose-headers"]
        assert answer.headers["cross-origin-resource-policy"] == "cross-origin"
        for other in ("https://evil.example", "http://show.example.org", f"{origin}.evil.example", "null"):
            assert "access-control-allow-origin" not in server.ask(address, Origin=other).headers
        wanted = {"Access_Control_Request_Method": "GET", "Access_Control_Request_Headers": "authorization, range"}
        asked = server.ask(address, method="OPTIONS", Origin=origin, **wanted)
        assert (asked.status, asked.headers["access-control-allow-origin"]) == (200, origin)
        assert server.ask(address, method="OPTIONS", Origin="https://evil.example", **wanted).status == 400
        assert "access-control-allow-credentials" not in answer.headers


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system does not tell the memory of a process")
def test_clients_that_take_nothing_cost_little_memory(folder: Path) -> None:
    with (folder / "large.sgs").open("wb") as file:
        file.truncate(400 * 10**6)
    with hosted(ServerSettings(folder)) as server:
        server.ask("/health")
        before = resident_bytes()
        connections = [server.connected() for _ in range(30)]
        for connection in connections:
            connection.sendall(b"GET /streams/large.sgs/stream.sgs HTTP/1.1\r\nHost: localhost\r\n\r\n")
        time.sleep(1.0)
        assert resident_bytes() - before < 50 * 10**6
        for connection in connections:
            connection.close()


def test_only_a_named_proxy_states_the_client(folder: Path) -> None:
    """Viewers are counted by connection, or by the address that the proxy states."""
    for proxies, viewers in ((("127.0.0.0/8",), 2), ((), 3)):
        with hosted(ServerSettings(folder), proxies=proxies) as server:
            for address in ("198.51.100.1", "203.0.113.7, 198.51.100.1", "198.51.100.2"):
                server.ask("/streams/studio/manifest.json", X_Forwarded_For=address)
            assert f'structgstream_viewers{{stream="studio"}} {viewers}.0' in server.ask("/metrics").text


def test_a_server_that_cannot_open_files_says_so(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*parts: object) -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(streams, "open_below", failing)
    answer = server.ask("/streams/ball.sgs/stream.sgs")
    assert (answer.status, answer.headers["retry-after"]) == (503, "5")
    assert b"Too many" not in answer.body
