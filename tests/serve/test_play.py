# SPDX-License-Identifier: Apache-2.0
"""The server of ``structgstream play``, asked through a socket, and its pictures of a capture on demand."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.errors import CaptureError
from structgstream.serve.pages import StreamFile, bundle
from structgstream.serve.play import Truth
from tests.support.memory_captures import MemoryCapture
from tests.support.pictures import decoded_picture
from tests.support.serving import Served, served
from tests.support.streams import small_stream

STREAM = small_stream(6)


@pytest.fixture(scope="module")
def source() -> FrameSource:
    return open_capture(bundled_clip_path(), scale=0.5)


@pytest.fixture
def file(tmp_path: Path) -> StreamFile:
    path = tmp_path / "name <&>.sgs"
    path.write_bytes(STREAM)
    return StreamFile(path)


@pytest.fixture
def server(file: StreamFile) -> Iterator[Served]:
    with served(file) as running:
        yield running


def test_the_page_the_player_and_the_state(server: Served) -> None:
    page = server.ask("/")
    assert page.status == 200
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert "<title>name &lt;&amp;&gt;.sgs</title>" in page.text
    assert 'src="stream"' in page.text
    assert "truth" not in page.text
    module = server.ask("/player.js")
    assert module.headers["content-type"].startswith("text/javascript")
    assert module.body.decode() == bundle()
    assert server.ask("/state").json == {"bytes": len(STREAM), "complete": True}
    assert server.ask("/truth.json").json == []
    assert server.ask("/truth/cam00/0.jpg").status == 404


def test_a_growing_file_is_asked_for_again_and_again(server: Served, file: StreamFile) -> None:
    file.path.write_bytes(STREAM[:1000])
    seen, frames = b"", [1500, 1501, 2600, len(STREAM)]
    for size in frames:
        answer = server.ask("/stream", Range=f"bytes={len(seen)}-")
        assert answer.status == 206
        seen += answer.body
        assert server.ask("/stream", Range=f"bytes={len(seen)}-").status == 416
        assert server.ask("/state").json == {"bytes": len(seen), "complete": False}
        with file.path.open("ab") as growing:
            growing.write(STREAM[len(seen) : size])
    assert seen + server.ask("/stream", Range=f"bytes={len(seen)}-").body == STREAM
    assert server.ask("/state").json == {"bytes": len(STREAM), "complete": True}


def test_nothing_of_a_growing_file_is_cached_and_no_validator_restarts_a_download(server: Served) -> None:
    for path in ("/", "/player.js", "/state", "/stream", "/truth.json"):
        headers = server.ask(path).headers
        assert headers["cache-control"] == "no-store"
        assert not {"etag", "last-modified"} & headers.keys()
    # Without a validator of ours nobody can know which version a part belongs to, so all of it is sent.
    assert server.ask("/stream", Range="bytes=5-9", If_Range='"x"').body == STREAM


def test_a_file_that_goes_away_and_comes_back(server: Served, file: StreamFile) -> None:
    file.path.unlink()
    for path in ("/stream", "/state"):
        gone = server.ask(path)
        assert gone.status == 404
        assert b"No such file or directory" in gone.body
    file.path.write_bytes(STREAM[:2000])
    assert server.ask("/stream").body == STREAM[:2000]


def test_other_names_for_this_machine_are_refused(server: Served) -> None:
    for host in ("evil.example:80", "localhost.evil", ""):
        assert server.ask("/stream", Host=host).status == 400
    for host in (f"localhost:{server.port}", "127.0.0.1", "LOCALHOST:8000"):
        assert server.ask("/state", Host=host).status == 200


def test_other_origins_may_not_read_and_the_page_loads_from_its_own_only(server: Served) -> None:
    for path in ("/", "/stream", "/player.js", "/state", "/nothing"):
        headers = server.ask(path, Origin="https://evil.example").headers
        assert "access-control-allow-origin" not in headers
    assert server.ask("/stream").headers["cross-origin-resource-policy"] == "same-origin"
    rules = dict(rule.split(" ", 1) for rule in server.ask("/").headers["content-security-policy"].split("; "))
    assert rules["default-src"] == "'none'"
    assert rules["connect-src"] == "'self' blob:"
    assert rules["frame-ancestors"] == "'self'"
    assert "http" not in " ".join(rules.values())


def test_addresses_name_no_files(file: StreamFile, source: FrameSource) -> None:
    with served(file, truth=Truth(source, ("cam00",))) as server:
        for path in (
            "/../../etc/passwd",
            "/stream/../../../etc/passwd",
            "/%2e%2e/%2e%2e/etc/passwd",
            "/player.js/../server.py",
            "/assets/player.js",
            "/truth/../../../../etc/passwd",
            "/truth/..%2f..%2f..%2fetc%2fpasswd/0.jpg",
            "/truth/cam00/../../../etc/passwd.jpg",
            "//etc/passwd",
        ):
            answer = server.ask(path)
            assert answer.status == 404, path
            assert b"root:" not in answer.body


def test_pictures_of_the_capture(file: StreamFile) -> None:
    source = open_capture(bundled_clip_path(), frames=3)
    names = tuple(source.rig)
    with served(file, truth=Truth(source, names)) as server:
        assert 'truth="truth.json"' in server.ask("/").text
        assert server.ask("/truth.json").json == list(names)
        answer = server.ask(f"/truth/{names[3]}/2.jpg")
        for missing in (f"{names[3]}/3", f"{names[3]}/-1", "nobody/0", f"{names[3]}/x", f"{names[3]}/1e0"):
            assert server.ask(f"/truth/{missing}.jpg").status == 404
    assert (answer.status, answer.headers["content-type"]) == (200, "image/jpeg")
    picture = decoded_picture(answer.body)
    taken = list(source.frames())[2].images[names[3]]
    assert picture.shape == taken.shape
    assert np.abs(picture.astype(int) - taken).mean() < 3


def test_any_order_gives_the_camera_and_frame_that_was_asked_for(source: FrameSource) -> None:
    frames = list(source.frames())
    taken = {(name, frame.index): frame.images[name] for frame in frames for name in ("cam00", "cam04")}
    truth = Truth(source, ("cam00", "cam04"))
    for camera, frame in [("cam00", 0), ("cam00", 1), ("cam00", 5), ("cam00", 4), ("cam04", 5), ("cam04", 0)]:
        picture = decoded_picture(truth.jpeg(camera, frame) or b"").astype(int)
        errors = {at: float(np.abs(picture - other).mean()) for at, other in taken.items()}
        assert min(errors, key=errors.__getitem__) == (camera, frame)
        assert errors[camera, frame] < 3


def test_what_was_asked_for_is_not_decoded_again(source: FrameSource) -> None:
    truth = Truth(source, ("cam00",))
    assert truth.jpeg("cam00", 3) is truth.jpeg("cam00", 3)


def test_a_video_that_breaks_is_reported_and_asked_again(tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    shutil.copytree(bundled_clip_path(), folder)
    truth = Truth(open_capture(folder), ("cam00",))
    assert truth.jpeg("cam00", 0)
    video = folder / "cam00.mp4"
    whole = video.read_bytes()
    video.unlink()
    with pytest.raises(CaptureError, match=r"cam00\.mp4"):
        truth.jpeg("cam00", 10)
    video.write_bytes(whole)
    assert truth.jpeg("cam00", 10)


def test_a_camera_that_is_absent_from_a_frame_has_no_picture_there(source: FrameSource) -> None:
    frames = list(source.frames())
    others = {name: image for name, image in frames[1].images.items() if name != "cam00"}
    frames[1] = replace(frames[1], images=others)
    truth = Truth(MemoryCapture(source.rig, frames), ("cam00", "cam04"))
    assert [truth.jpeg("cam00", frame) is None for frame in range(3)] == [False, True, False]
    assert truth.jpeg("cam04", 1) is not None
