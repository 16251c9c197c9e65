# SPDX-License-Identifier: Apache-2.0
"""Preview pictures: made apart, once for a key frame, and never in anybody's way."""

import asyncio
from pathlib import Path

import pytest

from streams import splat_stream
from structgstream.server import preview_picture, previews
from structgstream.server.catalog import Catalog, ServedStream
from structgstream.server.previews import AGAIN_SECONDS, MOST_PICTURE_BYTES, Previews, picture_in, rendered_apart

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def stream() -> bytes:
    return splat_stream()


class Maker:
    """Makes pictures when it is let, and counts them."""

    def __init__(self) -> None:
        self.made: list[str] = []
        self.together = self.most = 0
        self.free = asyncio.Event()
        self.free.set()

    async def __call__(self, stream: ServedStream) -> bytes:
        self.together += 1
        self.most = max(self.most, self.together)
        await self.free.wait()
        self.together -= 1
        self.made.append(stream.name)
        return PNG + str(len(self.made)).encode()


def streams(folder: Path, *names: str) -> list[ServedStream]:
    for name in names:
        (folder / f"{name}.sgs").touch()
    return list(Catalog(folder).found.values())


def test_one_picture_a_key_frame_and_at_most_one_a_minute(tmp_path: Path) -> None:
    (stream,) = streams(tmp_path, "a")

    async def run() -> None:
        seconds, maker = 0.0, Maker()
        found = Previews(maker, clock=lambda: seconds)

        async def asked(key: str) -> bytes:
            picture = await found.picture(stream, key)
            assert picture is not None
            await asyncio.sleep(0.05)
            return picture.content.removeprefix(PNG)

        assert await asyncio.gather(*(asked("first") for _ in range(20))) == [b"1"] * 20
        assert await asked("second") == b"1"  # not yet
        seconds = AGAIN_SECONDS
        assert await asked("first") == b"1"  # nothing new
        assert await asked("second") == b"1"  # the older one, while the newer one is made
        assert await asked("second") == b"2"
        assert maker.made == ["a.sgs"] * 2

    asyncio.run(run())


def test_one_at_a_time_and_so_many_in_a_queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = streams(tmp_path, *"abcde")
    monkeypatch.setattr(previews, "MOST_QUEUED", 3)

    async def run() -> None:
        maker = Maker()
        maker.free.clear()
        pictures = Previews(maker)
        asked = [asyncio.create_task(pictures.picture(one, "key")) for one in found]
        await asyncio.sleep(0.3)
        assert [one.done() for one in asked].count(True) == 2  # no picture yet
        maker.free.set()
        assert [await one is None for one in asked].count(True) == 2
        assert maker.most == 1

    asyncio.run(run())


def test_who_goes_away_does_not_end_what_others_wait_for(tmp_path: Path) -> None:
    (stream,) = streams(tmp_path, "a")

    async def run() -> None:
        maker = Maker()
        maker.free.clear()
        pictures = Previews(maker)
        first = asyncio.create_task(pictures.picture(stream, "key"))
        second = asyncio.create_task(pictures.picture(stream, "key"))
        await asyncio.sleep(0.1)
        first.cancel()
        maker.free.set()
        assert await second is not None

    asyncio.run(run())


def test_what_cannot_be_rendered_is_not_tried_again_at_once(tmp_path: Path) -> None:
    (stream,) = streams(tmp_path, "a")
    tried = 0

    async def failing(stream: ServedStream) -> bytes:
        nonlocal tried
        tried += 1
        return b""

    async def run() -> None:
        pictures = Previews(failing)
        for _ in range(5):
            assert await pictures.picture(stream, "key") is None
        assert await Previews(None).picture(stream, "key") is None

    asyncio.run(run())
    assert tried == 1


@pytest.mark.parametrize("content", [b"", b"<svg/>", b"GIF89a", PNG + bytes(MOST_PICTURE_BYTES)])
def test_what_is_no_picture(content: bytes) -> None:
    assert picture_in(content) is None


def test_the_process_apart_gives_the_whole_picture(tmp_path: Path, stream: bytes) -> None:
    (tmp_path / "ball.sgs").write_bytes(stream)
    (tmp_path / "broken.sgs").write_bytes(stream[:500])
    found = Catalog(tmp_path).found
    assert asyncio.run(rendered_apart(found["ball.sgs"])) == preview_picture.preview(found["ball.sgs"])
    assert asyncio.run(rendered_apart(found["broken.sgs"])) == b""


def test_a_process_that_takes_too_long_is_ended(tmp_path: Path, stream: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ball.sgs").write_bytes(stream)
    monkeypatch.setattr(previews, "RENDER_SECONDS", 0.05)
    assert asyncio.run(rendered_apart(Catalog(tmp_path).found["ball.sgs"])) == b""


def test_a_picture_that_is_too_large_keeps_nobody_waiting(
    tmp_path: Path, stream: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ball.sgs").write_bytes(stream)
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\nexec head -c 10000000 /dev/zero\n")
    program.chmod(0o755)
    monkeypatch.setattr(previews.sys, "executable", str(program))
    monkeypatch.setattr(previews, "RENDER_SECONDS", 1000.0)
    rendering = asyncio.wait_for(rendered_apart(Catalog(tmp_path).found["ball.sgs"]), 60.0)
    assert asyncio.run(rendering) == b""


def test_a_large_picture_comes_whole(tmp_path: Path, stream: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ball.sgs").write_bytes(stream)
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\nhead -c 100000 /dev/zero; sleep 0.2; head -c 200000 /dev/zero\n")
    program.chmod(0o755)
    monkeypatch.setattr(previews.sys, "executable", str(program))
    assert asyncio.run(rendered_apart(Catalog(tmp_path).found["ball.sgs"])) == bytes(300_000)
