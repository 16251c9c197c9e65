# SPDX-License-Identifier: Apache-2.0
"""A file that grows, and pages written from it."""

from pathlib import Path

import pytest

from structgstream.codec.reader import StreamReader
from structgstream.errors import StorageError, StreamError
from structgstream.serve.pages import StreamFile, check_has_header, write_page, write_site
from tests.support.streams import small_stream

STREAM = small_stream()
HEADER_BYTES = StreamReader(STREAM).header_bytes


@pytest.fixture
def file(tmp_path: Path) -> StreamFile:
    return StreamFile(tmp_path / "s.sgs")


def test_it_begins_with_its_header_and_is_complete_with_its_footer(file: StreamFile) -> None:
    assert not file.has_header()
    for length in (0, 5, 12, 13, HEADER_BYTES - 1, HEADER_BYTES, HEADER_BYTES + 3, len(STREAM) - 1, len(STREAM)):
        file.path.write_bytes(STREAM[:length])
        assert file.has_header() == (length >= HEADER_BYTES)
        assert file.state() == {"bytes": length, "complete": length == len(STREAM)}


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty; expected a stream made by structgstream reconstruct"),
        (b"hello, this is no stream", "is not a structgstream file"),
        (STREAM[:10], "cut at byte 10"),
        (STREAM[: HEADER_BYTES - 1], f"cut at byte {HEADER_BYTES - 1}, within the record that begins at byte 12"),
        (STREAM[:8] + b"\x09\x00" + STREAM[10:], "version 9.0"),
    ],
)
def test_what_cannot_be_shown_is_reported(file: StreamFile, data: bytes, words: str) -> None:
    file.path.write_bytes(data)
    with pytest.raises(StreamError, match=words):
        file.check()
    with pytest.raises(StreamError, match=words):
        check_has_header(data, "memory")


def test_a_missing_file_is_reported(file: StreamFile) -> None:
    with pytest.raises(StreamError, match=r"No such file or directory"):
        file.check()


@pytest.fixture
def stream(tmp_path: Path) -> StreamFile:
    path = tmp_path / "clip.sgs"
    path.write_bytes(STREAM)
    return StreamFile(path)


def test_a_site_never_replaces_its_own_stream(tmp_path: Path) -> None:
    path = tmp_path / "stream.sgs"
    path.write_bytes(STREAM)
    with pytest.raises(StorageError, match="is the stream itself"):
        write_site(tmp_path, StreamFile(path))
    assert path.read_bytes() == STREAM


def test_a_site_replaces_an_earlier_one_and_no_other_page(stream: StreamFile, tmp_path: Path) -> None:
    page = tmp_path / "www" / "index.html"
    for _ in range(2):
        write_site(page.parent, stream)
    page.write_text("<h1>My pages</h1>")
    with pytest.raises(StorageError, match="is another page"):
        write_site(page.parent, stream)
    assert page.read_text() == "<h1>My pages</h1>"


def test_what_cannot_be_shown_is_not_written(stream: StreamFile, tmp_path: Path) -> None:
    stream.path.write_bytes(STREAM[:100])
    for writing in (write_page, write_site):
        with pytest.raises(StreamError, match="cut at byte 100"):
            writing(tmp_path / "out", stream)
    assert [entry.name for entry in tmp_path.iterdir()] == ["clip.sgs"]
