# SPDX-License-Identifier: Apache-2.0
"""Files in memory: read once, bounded, and given in pieces."""

import asyncio
import random
from pathlib import Path

import pytest

from structgstream.server.file_cache import PIECE_BYTES, FileCache
from structgstream.server.files import OpenedFile, open_below


class Files:
    """Files of random bytes, and how often each was opened."""

    def __init__(self, folder: Path, *sizes: int) -> None:
        self.folder, self.times = folder, [0] * len(sizes)
        self.contents = [random.Random(size).randbytes(size) for size in sizes]
        for i, content in enumerate(self.contents):
            (folder / str(i)).write_bytes(content)

    def opener(self, i: int):
        def opened() -> OpenedFile | None:
            self.times[i] += 1
            return open_below(self.folder, str(i))

        return opened


async def got(cache: FileCache, files: Files, i: int, wanted: range | None = None) -> bytes | None:
    key, opener = ("stream", str(i)), files.opener(i)
    source = await cache.source(key, opener)
    if source is None:
        return None
    pieces = [piece async for piece in cache.pieces(key, source, wanted or range(source.size_bytes), opener)]
    assert max(map(len, pieces), default=0) <= PIECE_BYTES
    return b"".join(pieces)


def test_many_who_ask_at_once_cost_one_reading(tmp_path: Path) -> None:
    files = Files(tmp_path, 300_000)

    async def run() -> None:
        cache = FileCache()
        found = await asyncio.gather(*(got(cache, files, 0) for _ in range(50)))
        assert all(one == files.contents[0] for one in found)
        assert await got(cache, files, 0, range(70_000, 140_001)) == files.contents[0][70_000:140_001]

    asyncio.run(run())
    assert files.times == [1]


def test_memory_is_bounded_and_what_was_asked_for_last_stays(tmp_path: Path) -> None:
    files = Files(tmp_path, 1000, 1001, 1002, 1003)

    async def run() -> None:
        cache = FileCache(most_bytes=2500)
        for i in (0, 1, 0, 2, 0, 3):
            assert await got(cache, files, i) == files.contents[i]
            assert cache.cached_bytes <= 2500

    asyncio.run(run())
    assert files.times == [1, 1, 1, 1]


def test_large_and_empty_files_are_read_from_the_disk(tmp_path: Path) -> None:
    files = Files(tmp_path, 200_000, 0)

    async def run() -> None:
        cache = FileCache(most_file_bytes=100_000)
        for _ in range(2):
            assert await got(cache, files, 0) == files.contents[0]
            assert await got(cache, files, 1) == b""
        assert cache.cached_bytes == 0

    asyncio.run(run())


def test_what_leaves_the_cache_meanwhile_goes_on_from_the_disk(tmp_path: Path) -> None:
    files = Files(tmp_path, 300_000, 300_001)

    async def run(*, removed: bool) -> bytes:
        cache = FileCache(most_bytes=400_000)
        opener = files.opener(0)
        source = await cache.source(("stream", "0"), opener)
        assert source is not None
        pieces = cache.pieces(("stream", "0"), source, range(300_000), opener)
        content = await anext(pieces)
        assert await got(cache, files, 1) == files.contents[1]  # the first one has to leave
        if removed:
            (tmp_path / "0").unlink()
        return content + b"".join([piece async for piece in pieces])

    assert asyncio.run(run(removed=False)) == files.contents[0]
    assert asyncio.run(run(removed=True)) == files.contents[0][:PIECE_BYTES]


def test_no_file_is_no_source_and_an_error_is_one_for_all(tmp_path: Path) -> None:
    files = Files(tmp_path)

    def failing() -> None:
        raise OSError(24, "Too many open files")

    async def run() -> None:
        cache = FileCache()
        assert await cache.source(("stream", "x"), lambda: open_below(files.folder, "x")) is None
        asked = (cache.source(("stream", "y"), failing) for _ in range(5))
        outcomes = await asyncio.gather(*asked, return_exceptions=True)
        assert [type(one) for one in outcomes] == [OSError] * 5
        with pytest.raises(OSError, match="Too many"):
            await cache.source(("stream", "y"), failing)

    asyncio.run(run())
