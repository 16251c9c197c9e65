# SPDX-License-Identifier: Apache-2.0
"""Names in addresses, and opening files below a folder, never outside it."""

import errno
import gc
import os
import string
from pathlib import Path, PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.segments.manifest import file_name
from structgstream.serve.streams import hash_in_name, is_plain_path, is_stream_name, open_below
from tests.support.properties import examples


def content(folder: Path, *parts: str) -> bytes | None:
    """What is read below a folder; None where there is nothing."""
    opened = open_below(folder, *parts)
    if opened is None:
        return None
    with opened:
        return opened[:]


def test_nothing_that_is_no_file_is_opened(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    (tmp_path / "around").symlink_to(tmp_path / "folder")
    (tmp_path / "folder" / "inner").write_bytes(b"x")
    os.mkfifo(tmp_path / "pipe")
    assert content(tmp_path, "folder") is None
    assert content(tmp_path, "missing") is None
    assert content(tmp_path, "file", "below") is None
    assert content(tmp_path, "link") is None
    assert content(tmp_path, "around", "inner") is None
    assert content(tmp_path, "pipe") is None
    assert content(tmp_path, "x" * 300) is None
    assert content(tmp_path / "missing", "file") is None


def test_a_name_that_leads_up_is_a_mistake_of_ours(tmp_path: Path) -> None:
    for part in ("..", ".", "", "a/b"):
        with pytest.raises(AssertionError, match="plain names"):
            open_below(tmp_path, part)


def test_a_system_that_opens_no_files_is_no_missing_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object, **options: object) -> int:
        raise OSError(errno.EMFILE, "Too many open files")

    (tmp_path / "file").touch()
    monkeypatch.setattr(os, "open", full)
    with pytest.raises(OSError, match="Too many open files"):
        open_below(tmp_path, "file")


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    def count() -> int:
        return len(os.listdir("/proc/self/fd"))

    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "file").write_bytes(b"x")
    before = count()
    for parts in (("a", "file"), ("a",), ("a", "missing"), ("missing", "file"), ("a", "file", "x")):
        content(tmp_path, *parts)
    dropped = open_below(tmp_path, "a", "file")
    assert count() == before + 1
    del dropped
    gc.collect()
    assert count() == before


PLAIN = string.ascii_letters + string.digits + "._-"


@pytest.mark.parametrize("name", ["a", "ball.sgs", "A_b-c.9", "-x", "x" * 128])
def test_names_of_streams(name: str) -> None:
    assert is_stream_name(name)


@pytest.mark.parametrize("name", ["", ".", "..", ".a", "a/b", "a b", "a\n", "a%", "~", "ä", "x" * 129, "a\\b", "a:b"])
def test_no_names_of_streams(name: str) -> None:
    assert not is_stream_name(name)


def test_names_of_immutable_files() -> None:
    digits = "0123456789abcdef"
    for name in ("init-0000", "part-00000001", "segment-00000001", "segment-123456789"):
        assert hash_in_name(f"{name}-{digits}.sgs") == digits
    assert hash_in_name(f"history-00000000-{digits}.json") == digits
    for name in (
        "manifest.json", f"part-00000001-{digits}.json", f"part-00000001-{digits}.sgs.partial", "part-00000001.sgs",
        f"part-00000001-{digits.upper()}.sgs", f"xpart-00000001-{digits}.sgs", f"part-00000001-{digits}.sgs\n",
        f"history-00000000-{digits}.sgs", f".new-part-00000001-{digits}.sgs", "",
    ):  # fmt: skip
        assert hash_in_name(name) is None, name


def test_plain_paths() -> None:
    for path in (b"/", b"/streams/a.b-c_d/x", b"/a//b", b"/..."):
        assert is_plain_path(path)
    for path in (b"", b"a", b"/%61", b"/a/../b", b"/./a", b"/a/..", b"/a\\b", b"/a;b", b"/a b", b"/\xc3\xa4", b"/a\n"):
        assert not is_plain_path(path)


@given(st.text(max_size=8) | st.text(PLAIN + "/%~", max_size=8))
@examples(400)
def test_a_name_of_a_stream_is_one_part_of_an_address_as_it_stands(name: str) -> None:
    """What is served can be asked for: its path is plain, is one folder, and leads nowhere else."""
    if is_stream_name(name):
        path = f"/streams/{name}/"
        assert is_plain_path(path.encode("ascii"))
        assert PurePosixPath(path).parts == ("/", "streams", name)
        assert not name.startswith(".")


@given(st.integers(0, 2**32 - 1), st.binary(max_size=4))
@examples(200)
def test_the_hash_is_found_in_every_name_that_a_writer_gives(number: int, data: bytes) -> None:
    digest = data.hex().ljust(64, "0")
    for kind in ("init", "part", "segment", "history"):
        file = file_name(kind, number, digest)
        assert hash_in_name(file) == digest[:16]
        assert is_plain_path(f"/{file}".encode())
