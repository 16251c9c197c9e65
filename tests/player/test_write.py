# SPDX-License-Identifier: Apache-2.0
"""A stream file as a page and as a folder for a web server."""

from pathlib import Path

import pytest

from streams import small_stream
from structgstream.codec.reader import open_stream
from structgstream.errors import StorageError, StreamError
from structgstream.player.bundle import bundle
from structgstream.player.page import single_page
from structgstream.player.stream_file import StreamFile
from structgstream.player.write import write_page, write_site

STREAM = small_stream()


@pytest.fixture
def stream(tmp_path: Path) -> StreamFile:
    path = tmp_path / "clip.sgs"
    path.write_bytes(STREAM)
    return StreamFile(path)


def test_a_page(stream: StreamFile, tmp_path: Path) -> None:
    path = tmp_path / "new" / "clip.html"
    assert write_page(path, stream) == path.stat().st_size
    assert path.read_bytes() == single_page("clip", module=bundle(), stream=STREAM)


def test_a_site(stream: StreamFile, tmp_path: Path) -> None:
    site = tmp_path / "site"
    size_bytes = write_site(site, stream)
    assert sorted(entry.name for entry in site.iterdir()) == ["index.html", "player.js", "stream.sgs"]
    assert size_bytes == sum(entry.stat().st_size for entry in site.iterdir())
    assert (site / "player.js").read_text() == bundle()
    assert 'src="stream.sgs"' in (site / "index.html").read_text()
    with open_stream(site / "stream.sgs") as reader:
        assert reader.complete


def test_a_site_never_replaces_its_own_stream(tmp_path: Path) -> None:
    path = tmp_path / "stream.sgs"
    path.write_bytes(STREAM)
    with pytest.raises(StorageError, match="is the stream itself"):
        write_site(tmp_path, StreamFile(path))
    assert path.read_bytes() == STREAM


def test_what_cannot_be_shown_is_not_written(stream: StreamFile, tmp_path: Path) -> None:
    stream.path.write_bytes(STREAM[:100])
    for writing in (write_page, write_site):
        with pytest.raises(StreamError, match="cut at byte 100"):
            writing(tmp_path / "out", stream)
    assert [entry.name for entry in tmp_path.iterdir()] == ["clip.sgs"]
