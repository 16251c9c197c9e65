# SPDX-License-Identifier: Apache-2.0
"""The server of ``structgstream serve``, asked through a socket."""

import hashlib
import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from structgstream.codec.segments.manifest import manifest_from_json
from structgstream.codec.segments.quality_list import ListedQuality, list_from_json, write_list
from structgstream.serve.app import ServerSettings
from structgstream.serve.pages import bundle
from tests.support.segment_folders import GrowingFolder
from tests.support.serving import Served, hosted
from tests.support.streams import small_stream
from tests.support.waiting import wait_until

STREAM = small_stream(7)
PNG = b"\x89PNG\r\n\x1a\n not a whole picture"
SOON_SECONDS = 0.3
YEAR = "public, max-age=31536000, immutable"


def studio(folder: Path, *, frames: int = 1) -> GrowingFolder:
    """A live stream in a folder."""
    growing = GrowingFolder(folder / "studio", STREAM)
    for _ in range(frames):
        growing.write()
    return growing


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A live stream with two segments and a part, and a file."""
    studio(tmp_path, frames=7)
    (tmp_path / "ball.sgs").write_bytes(STREAM)
    (tmp_path / "notes.txt").write_text("not for viewers")
    return tmp_path


@pytest.fixture
def server(folder: Path) -> Iterator[Served]:
    with hosted(ServerSettings(folder, wait_seconds=SOON_SECONDS)) as running:
        yield running


def test_the_list(server: Served) -> None:
    values = server.ask("/streams.json").json["streams"]
    assert [(one["name"], one["kind"], one["live"]) for one in values] == [
        ("ball.sgs", "file", None),
        ("studio", "segments", True),
    ]
    assert values[1] == {
        "name": "studio", "kind": "segments", "live": True, "seconds": pytest.approx(6 / 30),
        "page": "streams/studio/", "stream": "streams/studio/manifest.json", "preview": "streams/studio/preview",
    }  # fmt: skip
    for one in values:
        assert server.ask(f"/{one['page']}").status == 200
        assert server.ask(f"/{one['stream']}").status == 200
    page = server.ask("/").text
    for name in ("studio", "ball.sgs"):
        assert f'href="streams/{name}/"' in page
        assert f"url(&quot;streams/{name}/preview&quot;)" in page
    assert "notes" not in page


def test_the_page_plays_what_is_beside_it(server: Served) -> None:
    for name, source in (("studio", "manifest.json"), ("ball.sgs", "stream.sgs")):
        page = server.ask(f"/streams/{name}/")
        assert page.headers["content-type"] == "text/html; charset=utf-8"
        assert f'src="{source}"' in page.body.decode()
        assert 'src="../../player.js"' in page.body.decode()
        assert "frame-ancestors 'self'" in page.headers["content-security-policy"]
        moved = server.ask(f"/streams/{name}?t=3")
        assert (moved.status, moved.headers["location"]) == (307, f"{name}/?t=3")
    assert server.ask("/player.js").text == bundle()


def test_a_player_gets_every_byte_of_the_stream(server: Served) -> None:
    answer = server.ask("/streams/studio/manifest.json")
    manifest = manifest_from_json(answer.body, name="it")
    assert (len(manifest.segments), len(manifest.parts)) == (2, 1)
    entries = [*manifest.periods, *manifest.segments, *manifest.parts]
    content = b""
    for entry in entries:
        got = server.ask(f"/streams/studio/{entry.file}")
        assert hashlib.sha256(got.body).hexdigest() == entry.sha256
        assert got.headers["cache-control"] == YEAR
        assert got.headers["content-type"] == "application/octet-stream"
        content += got.body
    assert STREAM.startswith(content)
    assert len(STREAM) - len(content) < 500  # index and footer


def test_an_immutable_file_has_ranges_and_a_validator(server: Served, folder: Path) -> None:
    file = next((folder / "studio").glob("init-*"))
    content, address = file.read_bytes(), f"/streams/studio/{file.name}"
    etag = server.ask(address).headers["etag"]
    assert etag == f'"{hashlib.sha256(content).hexdigest()[:16]}"'
    part = server.ask(address, Range="bytes=10-19")
    assert (part.status, part.body, part.headers["cache-control"]) == (206, content[10:20], YEAR)
    assert server.ask(address, Range="bytes=10-19", If_Range=etag).body == content[10:20]
    assert server.ask(address, Range="bytes=10-19", If_Range='"other"').body == content
    assert server.ask(address, Range=f"bytes={len(content)}-").status == 416
    for given in (etag, f"W/{etag}", f'"x", {etag}', "*"):
        known = server.ask(address, If_None_Match=given)
        assert (known.status, known.body, known.headers["etag"]) == (304, b"", etag)
    reported = server.ask(address, method="HEAD")
    assert (reported.status, reported.body, reported.headers["content-length"]) == (200, b"", str(len(content)))


def test_the_manifest_has_a_validator(server: Served, folder: Path) -> None:
    answer = server.ask("/streams/studio/manifest.json", Accept_Encoding="gzip")
    assert answer.body == (folder / "studio" / "manifest.json").read_bytes()
    assert not answer.headers["etag"].startswith("W/")
    assert (answer.headers["cache-control"], answer.headers["content-type"]) == ("no-cache", "application/json")
    for given, status in ((answer.headers["etag"], 304), (f"W/{answer.headers['etag']}", 304), ('"old"', 200)):
        assert server.ask("/streams/studio/manifest.json", If_None_Match=given).status == status


def test_waiting_ends_with_the_next_frame_for_everyone(tmp_path: Path) -> None:
    growing = studio(tmp_path)
    settings = ServerSettings(tmp_path, wait_seconds=30.0)
    with hosted(settings) as server, ThreadPoolExecutor(12) as pool:
        waiting = [pool.submit(server.ask, "/streams/studio/manifest.json?after=1") for _ in range(12)]
        wait_until(lambda: waiters(server) == 12)
        assert not any(one.done() for one in waiting)
        growing.write()
        assert [one.result(20).json["sequence"] for one in waiting] == [2] * 12
        # Who is behind does not wait, nor who asks a finished stream.
        assert server.ask("/streams/studio/manifest.json?after=1").status == 200
        growing.write_all()
        assert not server.ask("/streams/studio/manifest.json?after=99").json["live"]


def waiters(server: Served) -> float:
    lines = server.ask("/metrics").text.splitlines()
    return sum(float(line.split()[-1]) for line in lines if line.startswith("structgstream_waiters"))


def test_waiting_ends_by_itself(server: Served) -> None:
    address = "/streams/studio/manifest.json?after=7"
    same = server.ask(address)
    assert same.json["sequence"] == 7
    assert server.ask(address, If_None_Match=same.headers["etag"]).status == 304


def test_a_stream_that_begins_anew_ends_waiting(tmp_path: Path) -> None:
    studio(tmp_path, frames=3)
    with hosted(ServerSettings(tmp_path)) as server, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(server.ask, "/streams/studio/manifest.json?after=3")
        wait_until(lambda: waiters(server))
        GrowingFolder(tmp_path / "studio", STREAM, name="another").write()
        assert waiting.result(20).json["sequence"] == 1


WAITING = b"GET /streams/studio/manifest.json?after=1 HTTP/1.1\r\nHost: localhost\r\n\r\n"


def test_who_goes_away_no_longer_waits(tmp_path: Path) -> None:
    studio(tmp_path)
    with hosted(ServerSettings(tmp_path)) as server:
        with server.connected() as connection:
            connection.sendall(WAITING)
            wait_until(lambda: waiters(server))
        wait_until(lambda: not waiters(server))


def test_too_many_connections_are_reported_to_come_back(tmp_path: Path) -> None:
    studio(tmp_path)
    with hosted(ServerSettings(tmp_path), connections=1) as server:
        assert server.ask("/health").status == 200
    with hosted(ServerSettings(tmp_path), connections=1) as server, server.connected() as connection:
        connection.sendall(WAITING)
        wait_until(lambda: server.ask("/health").status == 503)


def test_a_head_does_not_wait(tmp_path: Path) -> None:
    studio(tmp_path)
    with hosted(ServerSettings(tmp_path, wait_seconds=1000.0)) as server:
        assert server.ask("/streams/studio/manifest.json?after=9", method="HEAD").status == 200


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'{"format": "other"}', b"[" * 100_000])
def test_a_broken_manifest_is_reported(folder: Path, content: bytes) -> None:
    (folder / "studio" / "manifest.json").write_bytes(content)
    with hosted(ServerSettings(folder)) as server:
        answer = server.ask("/streams/studio/manifest.json")
        assert (answer.status, answer.headers["cache-control"]) == (502, "no-store")
        assert b"is no manifest" in answer.body
        assert server.ask("/").status == 200
        assert server.ask("/metrics").status == 200


def test_a_growing_file_as_play_serves_it(server: Served, folder: Path) -> None:
    address, path = "/streams/ball.sgs/stream.sgs", folder / "ball.sgs"
    assert server.ask("/streams/ball.sgs/state").json == {"bytes": len(STREAM), "complete": True}
    path.write_bytes(STREAM[:1000])
    assert server.ask("/streams/ball.sgs/state").json == {"bytes": 1000, "complete": False}
    assert server.ask(address, Range="bytes=1000-").status == 416
    with path.open("ab") as growing:
        growing.write(STREAM[1000:])
    part = server.ask(address, Range="bytes=1000-")
    assert (part.status, part.body, part.headers["cache-control"]) == (206, STREAM[1000:], "no-store")
    assert "etag" not in part.headers
    assert server.ask(address).body == STREAM
    assert server.ask(address, Range="bytes=5-9", If_Range='"x"').body == STREAM
    assert server.ask(address, method="HEAD").headers["content-length"] == str(len(STREAM))


def test_only_what_a_stream_is_made_of_is_served(server: Served, folder: Path) -> None:
    for name in ("secret.sgs", "part-00000001.sgs", ".new-manifest.json", "studio.metrics.json"):
        (folder / "studio" / name).write_text("hidden")
    for address in (
        "/notes.txt",
        "/streams/notes.txt/",
        "/streams/notes.txt/stream.sgs",
        "/streams/studio/secret.sgs",
        "/streams/studio/part-00000001.sgs",
        "/streams/studio/.new-manifest.json",
        "/streams/studio/studio.metrics.json",
        "/streams/studio/stream.sgs",
        "/streams/ball.sgs/manifest.json",
        "/streams/nobody/",
        "/streams/",
        "/streams/studio/x/y",
    ):
        answer = server.ask(address)
        assert answer.status == 404, address
        assert b"hidden" not in answer.body


def test_a_folder_of_segments_is_one_stream(tmp_path: Path) -> None:
    GrowingFolder(tmp_path / "studio", STREAM).write_all()
    (tmp_path / "studio.metrics.json").write_text(json.dumps({"frames": 7}))
    (tmp_path / "other.sgs").write_bytes(STREAM)
    with hosted(ServerSettings(tmp_path / "studio")) as server:
        values = server.ask("/streams.json").json["streams"]
        assert [(one["name"], one["live"]) for one in values] == [("studio", False)]
        assert server.ask("/streams/studio/manifest.json").status == 200
        assert 'structgstream_run{name="frames",stream="studio"} 7.0' in server.ask("/metrics").text


def test_metrics_and_health(server: Served, folder: Path) -> None:
    run = {"frames": 7, "psnr": {"mean": 30.5}, "done": False, "cameras": ["a"], "name": "x"}
    (folder / "studio.metrics.json").write_text(json.dumps(run))
    (folder / "ball.metrics.json").write_text("{broken")
    assert server.ask("/health").json == {"status": "ok"}
    size = len(server.ask("/streams/studio/manifest.json").body)
    server.ask("/streams/studio/manifest.json", method="HEAD")
    server.ask("/nothing")
    answer = server.ask("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    lines = answer.body.decode().splitlines()
    for line in (
        'structgstream_requests_total{kind="manifest",status="200",stream="studio"} 2.0',
        'structgstream_requests_total{kind="other",status="404",stream=""} 1.0',
        f'structgstream_sent_bytes_total{{stream="studio"}} {float(size)}',
        'structgstream_live{stream="studio"} 1.0',
        'structgstream_edge_frame{stream="studio"} 6.0',
        'structgstream_manifest_sequence{stream="studio"} 7.0',
        'structgstream_viewers{stream="studio"} 2.0',
        'structgstream_run{name="frames",stream="studio"} 7.0',
        'structgstream_run{name="psnr_mean",stream="studio"} 30.5',
        'structgstream_run{name="done",stream="studio"} 0.0',
        "structgstream_requests_in_progress 1.0",
    ):
        assert line in lines
    assert not [line for line in lines if "nothing" in line]


def test_a_preview_that_is_a_file_is_taken(server: Served, folder: Path) -> None:
    (folder / "studio" / "preview.jpg").write_bytes(b"\xff\xd8\xff and so on")
    (folder / "ball.preview.png").write_bytes(PNG)
    jpeg = server.ask("/streams/studio/preview")
    assert (jpeg.headers["content-type"], jpeg.body) == ("image/jpeg", b"\xff\xd8\xff and so on")
    assert server.ask("/streams/ball.sgs/preview").body == PNG
    assert server.ask("/streams/studio/preview", If_None_Match=jpeg.headers["etag"]).status == 304
    (folder / "studio" / "preview.jpg").write_bytes(b"<svg onload=alert(1)>")
    assert server.ask("/streams/studio/preview").status == 404
    (folder / "studio" / "preview.jpg").unlink()
    assert server.ask("/streams/studio/preview").status == 404
    with (folder / "studio" / "preview.png").open("wb") as large:
        large.write(PNG)
        large.truncate(3 * 10**6)
    assert server.ask("/streams/studio/preview").status == 404


def test_several_qualities_of_one_stream(server: Served, folder: Path) -> None:
    """As a run makes them, that comes while the server runs."""
    listed = [ListedQuality(name, f"{name}/manifest.json", bits) for name, bits in (("high", 6e6), ("low", 1e6))]
    (folder / "show").mkdir()
    write_list(folder / "show", listed)
    growing = {name: GrowingFolder(folder / "show" / name, STREAM) for name in ("low", "high")}
    growing["low"].write()
    assert server.ask("/streams/show/").status == 404, "high has no frame yet"
    growing["high"].write()
    wait_until(lambda: server.ask("/streams/show/").status != 404)
    assert 'src="qualities.json"' in server.ask("/streams/show/").text
    reported = server.ask("/streams/show/qualities.json")
    assert list_from_json(reported.body, name="it") == tuple(listed)
    assert (reported.headers["cache-control"], reported.headers["content-type"]) == ("no-cache", "application/json")
    assert server.ask("/streams/show/qualities.json", If_None_Match=reported.headers["etag"]).status == 304
    write_list(folder / "show", listed[::-1])
    assert server.ask("/streams/show/qualities.json", If_None_Match=reported.headers["etag"]).status == 200
    for name in ("low", "high"):
        manifest = manifest_from_json(server.ask(f"/streams/show/{name}/manifest.json").body, name="it")
        part = server.ask(f"/streams/show/{name}/{manifest.parts[0].file}")
        assert hashlib.sha256(part.body).hexdigest() == manifest.parts[0].sha256
        assert part.headers["cache-control"] == YEAR
    asked = ThreadPoolExecutor(1).submit(server.ask, "/streams/show/low/manifest.json?after=1")
    growing["low"].write()
    assert asked.result().json["sequence"] == 2
    for address in (
        "show/manifest.json", "show/none/manifest.json", "show/low/qualities.json", "show/low/",
        "studio/qualities.json", "studio/studio/manifest.json", "show/low/low/manifest.json",
        "ball.sgs/low/manifest.json",
    ):  # fmt: skip
        assert server.ask(f"/streams/{address}").status == 404, address
    numbers = server.ask("/metrics").text
    assert 'structgstream_viewers{stream="show/low"}' in numbers
    assert 'structgstream_requests_total{kind="qualities",status="200",stream="show"} 2.0' in numbers
    (folder / "show" / "high" / "preview.png").write_bytes(PNG)
    assert server.ask("/streams/show/preview").body == PNG


@pytest.mark.parametrize("seconds", ["null", '"1"', "true", "1e300", "[]"])
def test_a_manifest_may_hold_anything(folder: Path, seconds: str) -> None:
    """Values that are no numbers are left out."""
    text = json.dumps({"format": "structgstream-segments", "sequence": 3, "live": False, "edge": {"pts_seconds": 7.5}})
    (folder / "studio" / "manifest.json").write_text(text.replace("7.5", seconds))
    with hosted(ServerSettings(folder)) as server:
        (studio,) = (one for one in server.ask("/streams.json").json["streams"] if one["name"] == "studio")
        assert (studio["live"], studio["seconds"]) == (False, None)
        lines = server.ask("/metrics").text.splitlines()
        assert 'structgstream_manifest_sequence{stream="studio"} 3.0' in lines
        assert not [line for line in lines if line.startswith("structgstream_edge_frame{")]


def test_a_stream_that_has_been_removed(server: Served, folder: Path) -> None:
    assert len(server.ask("/streams.json").json["streams"]) == 2
    (folder / "ball.sgs").unlink()
    (folder / "studio" / "manifest.json").unlink()
    time.sleep(0.2)
    assert server.ask("/streams/ball.sgs/stream.sgs").status == 404
    assert server.ask("/streams/studio/manifest.json").status == 404
