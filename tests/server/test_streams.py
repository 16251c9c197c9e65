# SPDX-License-Identifier: Apache-2.0
"""The streams of a running server, and what is told about them."""

import asyncio
import json
from pathlib import Path

import pytest

from segment_folders import GrowingFolder
from streams import small_stream
from structgstream.codec.segments.quality_list import ListedQuality, write_list
from structgstream.server import streams as module
from structgstream.server.catalog import LOOK_AGAIN_SECONDS, Catalog, ServedStream
from structgstream.server.metrics import Family
from structgstream.server.streams import Streams

STREAM = small_stream(4)
PNG = b"\x89PNG\r\n\x1a\n"
NOW = 1.7e9 + 100.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A live stream of two frames, and a file."""
    growing = GrowingFolder(tmp_path / "studio", STREAM)
    growing.write()
    growing.write()
    (tmp_path / "ball.sgs").write_bytes(STREAM)
    return tmp_path


def streams(folder: Path, *, rendered: list[str] | None = None) -> Streams:
    async def render(stream: ServedStream) -> bytes:
        assert rendered is not None
        rendered.append(stream.name)
        return PNG + str(len(rendered)).encode()

    return Streams(Catalog(folder), render=None if rendered is None else render, clock=lambda: NOW)


def numbers(families: list[Family]) -> dict[str, dict[str, float]]:
    """Samples by metric and by their labels' values."""
    return {
        one.name.removeprefix("structgstream_"): {"/".join(labels.values()): value for labels, value in one.samples}
        for one in families
    }


def test_streams_by_name_and_in_order(folder: Path) -> None:
    async def run() -> None:
        found = streams(folder)
        assert [one.name for one in await found.all()] == ["ball.sgs", "studio"]
        assert await found.named("studio") == (await found.all())[1]
        assert await found.named("none") is None

    asyncio.run(run())


def test_streams_that_come_later_are_found(folder: Path) -> None:
    async def run() -> None:
        seconds = 0.0
        found = Streams(Catalog(folder, clock=lambda: seconds), render=None)
        (folder / "new.sgs").write_bytes(STREAM)
        assert await found.named("new.sgs") is None
        seconds = LOOK_AGAIN_SECONDS
        assert await found.named("new.sgs") is not None

    asyncio.run(run())


def test_what_the_list_says(folder: Path) -> None:
    async def run() -> None:
        found = streams(folder)
        ball, studio = [await found.listed(one) for one in await found.all()]
        assert (ball.name, ball.kind, ball.live, ball.seconds) == ("ball.sgs", "file", None, None)
        assert (studio.kind, studio.live, studio.seconds) == ("segments", True, pytest.approx(1 / 30))

    asyncio.run(run())


@pytest.mark.parametrize("seconds", ["null", '"1"', "true", "NaN", "Infinity", "1e300", "[]"])
def test_a_manifest_may_say_anything(folder: Path, seconds: str) -> None:
    """Numbers that are none are left out, and no list is lost because of them."""
    text = json.dumps({"format": "structgstream-segments", "sequence": 3, "live": False, "edge": {"pts_seconds": 7.5}})
    (folder / "studio" / "manifest.json").write_text(text.replace("7.5", seconds))

    async def run() -> None:
        found = streams(folder)
        listed = await found.listed((await found.all())[1])
        assert (listed.live, listed.seconds) == (False, None)
        shown = numbers(await found.families())
        assert (shown["manifest_sequence"], shown["edge_frame"], shown["live"]) == ({"studio": 3.0}, {}, {"studio": 0})

    asyncio.run(run())


@pytest.mark.parametrize("content", [b"", b"[]", b"no manifest"])
def test_a_broken_manifest_says_nothing(folder: Path, content: bytes) -> None:
    (folder / "studio" / "manifest.json").write_bytes(content)

    async def run() -> None:
        found = streams(folder)
        studio = (await found.all())[1]
        assert await found.manifest(studio) is None
        assert (await found.listed(studio)).live is None
        assert numbers(await found.families())["live"] == {}

    asyncio.run(run())


def test_numbers_of_streams_and_of_their_runs(folder: Path) -> None:
    (folder / "ball.metrics.json").write_text('{"psnr": {"mean": 30.5}}')

    async def run() -> None:
        shown = numbers(await streams(folder).families())
        assert shown["live"] == {"studio": 1.0}
        assert shown["edge_frame"] == {"studio": 1.0}
        assert shown["edge_age_seconds"] == {"studio": pytest.approx(99.0)}
        assert shown["waiters"] == {"studio": 0.0}
        assert shown["cached_bytes"] == {"": 0.0}
        assert shown["run"] == {"ball.sgs/psnr_mean": 30.5}

    asyncio.run(run())


def test_long_numbers_of_a_run_are_cut(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_RUN_BYTES", 5)
    (folder / "ball.metrics.json").write_text('{"psnr": 30.5}')
    assert numbers(asyncio.run(streams(folder).families()))["run"] == {}


def test_who_waits_is_counted(folder: Path) -> None:
    async def run() -> None:
        found = streams(folder)
        studio = (await found.all())[1]
        waiting = asyncio.create_task(found.watch(studio).newer(10**6, seconds=30.0))
        while not found.waiters:
            await asyncio.sleep(0.01)
        assert numbers(await found.families())["waiters"] == {"studio": 1.0}
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        assert found.waiters == 0

    asyncio.run(run())


def test_so_many_watchers_are_kept_and_those_that_wait_stay(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_WATCHES", 2)
    GrowingFolder(folder / "second", STREAM).write()
    GrowingFolder(folder / "third", STREAM).write()

    async def run() -> None:
        found = streams(folder)
        named = {one.name: one for one in await found.all()}
        watch = found.watch(named["second"])
        waiting = asyncio.create_task(watch.newer(10**6, seconds=30.0))
        while not watch.waiters:
            await asyncio.sleep(0.01)
        idle = found.watch(named["studio"])
        assert found.watch(named["studio"]) is idle
        found.watch(named["third"])
        assert found.watch(named["second"]) is watch
        assert found.watch(named["studio"]) is not idle
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)

    asyncio.run(run())


def test_a_preview_is_made_again_when_there_is_another_key_frame(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The key of a preview: the newest key packet of segments, the end of a file."""

    async def keys() -> list[str | None]:
        found, asked = streams(folder, rendered=[]), []

        async def picture(stream: ServedStream, key: str) -> None:
            asked.append(key)

        monkeypatch.setattr(found._previews, "picture", picture)
        for one in await found.all():
            await found.preview(one)
        return asked

    ball, studio = asyncio.run(keys())
    growing = GrowingFolder(folder / "studio", STREAM)
    for _ in range(3):
        growing.write()
    assert asyncio.run(keys()) == [ball, studio]
    growing.write()  # a key packet
    (folder / "ball.sgs").write_bytes(STREAM[:-1])
    now_ball, now_studio = asyncio.run(keys())
    assert now_ball is not None
    assert now_ball.endswith("growing") != (ball or "").endswith("growing")
    assert now_studio != studio


def test_a_preview_of_what_is_gone(folder: Path) -> None:
    async def run() -> None:
        rendered: list[str] = []
        found = streams(folder, rendered=rendered)
        ball, studio = await found.all()
        assert (await found.preview(studio) or pytest.fail("no picture")).content == PNG + b"1"
        (folder / "ball.sgs").unlink()
        (folder / "studio" / "manifest.json").unlink()
        assert await found.preview(ball) is None
        assert rendered == ["studio"]

    asyncio.run(run())


def test_several_qualities_are_one_stream_of_the_list_and_several_of_the_numbers(tmp_path: Path) -> None:
    for name, frames in (("low", 2), ("high", 1)):
        growing = GrowingFolder(tmp_path / "show" / name, STREAM)
        for _ in range(frames):
            growing.write()
    write_list(
        tmp_path / "show", [ListedQuality(n, f"{n}/manifest.json", bits) for n, bits in (("high", 9.0), ("low", 2.0))]
    )
    (tmp_path / "show.metrics.json").write_text('{"qualities": {"low": {"train_psnr": 30.5, "bytes": 7}}}')

    async def run() -> None:
        rendered: list[str] = []
        found = streams(tmp_path, rendered=rendered)
        (show,) = await found.all()
        listed = await found.listed(show)
        assert (listed.kind, listed.live, listed.seconds) == ("qualities", True, pytest.approx(1 / 30))
        assert listed.as_json()["stream"] == "streams/show/qualities.json"
        assert await found.preview(show) is not None
        assert rendered == ["show/high"]
        shown = numbers(await found.families())
        assert shown["edge_frame"] == {"show/low": 1.0, "show/high": 0.0}
        assert shown["live"] == {"show/low": 1.0, "show/high": 1.0}
        assert shown["run"] == {"show/qualities_low_train_psnr": 30.5, "show/qualities_low_bytes": 7.0}

    asyncio.run(run())
