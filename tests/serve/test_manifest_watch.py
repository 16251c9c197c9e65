# SPDX-License-Identifier: Apache-2.0
"""The present manifest, and one watcher for everyone who waits."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from structgstream.codec.container.byte_source import FileBytes
from structgstream.serve.manifest_watch import BrokenManifest, ManifestWatch, snapshot
from structgstream.serve.streams import open_below
from tests.support.segment_folders import GrowingFolder
from tests.support.streams import small_stream

STREAM = small_stream(7)
LONG_SECONDS = 30.0


class Opener:
    """Opens the manifest, and counts how often."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.times = folder, 0

    def __call__(self) -> FileBytes | None:
        self.times += 1
        return open_below(self.folder, "manifest.json")


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(LONG_SECONDS):
        while not condition():
            await asyncio.sleep(0.01)


def test_a_hundred_wait_at_the_price_of_one(tmp_path: Path) -> None:
    growing, opener = GrowingFolder(tmp_path, STREAM), Opener(tmp_path)
    growing.write()

    async def run() -> tuple[list[int], float, float]:
        watch = ManifestWatch(opener)
        waiting = [asyncio.create_task(watch.newer(1, seconds=LONG_SECONDS)) for _ in range(100)]
        await until(lambda: watch.waiters == 100)
        loop = asyncio.get_running_loop()
        began, before = loop.time(), opener.times
        await asyncio.sleep(1.0)
        looks, seconds = opener.times - before, loop.time() - began
        growing.write()
        found = await asyncio.gather(*waiting)
        return [one.sequence for one in found if one], looks, seconds

    sequences, looks, seconds = asyncio.run(run())
    assert sequences == [2] * 100
    assert 1 <= looks <= 10 * seconds + 2


def test_nobody_looks_while_nobody_waits(tmp_path: Path) -> None:
    GrowingFolder(tmp_path, STREAM).write()
    opener = Opener(tmp_path)

    async def run() -> None:
        watch = ManifestWatch(opener)
        await watch.newer(1, seconds=0.01)
        await asyncio.sleep(0.3)
        before = opener.times
        await asyncio.sleep(0.5)
        assert opener.times == before
        assert watch.waiters == 0

    asyncio.run(run())


def test_a_manifest_that_goes_and_comes_back(tmp_path: Path) -> None:
    growing = GrowingFolder(tmp_path, STREAM)
    growing.write()

    async def run() -> None:
        seconds = 0.0
        watch = ManifestWatch(Opener(tmp_path), clock=lambda: seconds)
        assert await watch.current() is not None
        (tmp_path / "manifest.json").unlink()
        seconds = 1.0
        assert await watch.current() is None
        assert await watch.newer(1, seconds=LONG_SECONDS) is None  # at once
        (tmp_path / "manifest.json").write_bytes(b"{}")
        seconds = 2.0
        for _ in range(2):
            with pytest.raises(BrokenManifest, match="has no 'format'"):
                await watch.current()
        growing.write()
        seconds = 3.0
        found = await watch.current()
        assert found is not None
        assert found.sequence == 2

    asyncio.run(run())


@pytest.mark.parametrize(
    "content",
    [
        b'{"format": "structgstream-segments", "sequence": 99999999999999999999, "live": true}',
        b'{"format": "structgstream-segments", "sequence": 1}',
    ],
)
def test_what_is_no_manifest(content: bytes) -> None:
    with pytest.raises(BrokenManifest):
        snapshot(content)
