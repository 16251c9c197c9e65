# SPDX-License-Identifier: Apache-2.0
"""The streams of a folder: their names in addresses, and opening files below it, never outside."""

import errno
import gc
import os
import string
from pathlib import Path, PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.segments.manifest import file_name
from structgstream.codec.segments.quality_list import ListedQuality, write_list
from structgstream.errors import PlayerError
from structgstream.serve.streams import (
    REFRESH_SECONDS,
    Catalog,
    StreamKind,
    hash_in_name,
    is_plain_path,
    is_stream_name,
    open_below,
)
from tests.support.properties import examples


def test_what_is_a_stream(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("b.sgs", "a.SGS", "c.sgs.partial", ".hidden.sgs", "a b.sgs", "ä.sgs"):
        (tmp_path / name).touch()
    for name in ("studio", "empty", ".dot", "z.sgs"):
        (tmp_path / name).mkdir()
    for name in ("studio", ".dot"):
        (tmp_path / name / "manifest.json").touch()
    catalog = Catalog(tmp_path)
    assert [(name, one.kind) for name, one in catalog.found().items()] == [
        ("b.sgs", StreamKind.FILE),
        ("studio", StreamKind.SEGMENTS),
    ]
    catalog._list()
    for name in ("a b.sgs", "ä.sgs"):
        assert caplog.text.count(f"The stream {name!r} is not served, because names of streams are") == 1


def test_it_looks_again_after_a_second(tmp_path: Path) -> None:
    seconds = 0.0
    catalog = Catalog(tmp_path, clock=lambda: seconds)
    (tmp_path / "new.sgs").touch()
    assert not catalog.found()
    seconds = REFRESH_SECONDS
    assert set(catalog.found()) == {"new.sgs"}


def test_what_is_no_folder(tmp_path: Path) -> None:
    with pytest.raises(PlayerError, match="cannot be read"):
        Catalog(tmp_path / "none")
    (tmp_path / "file.sgs").touch()
    with pytest.raises(PlayerError, match=rf"is a file; serve takes a folder of streams: {tmp_path}"):
        Catalog(tmp_path / "file.sgs")
    (tmp_path / "Studio 1").mkdir()
    (tmp_path / "Studio 1" / "manifest.json").touch()
    with pytest.raises(PlayerError, match=r"Studio 1 cannot be served, because names of streams are .*; rename it\."):
        Catalog(tmp_path / "Studio 1")


def test_the_folder_itself_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.sgs").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    stream = Catalog(tmp_path / "link").found()["a.sgs"]
    opened = stream.open_whole()
    assert opened is not None
    with opened:
        assert opened[:] == b"x"


def several(folder: Path, *names: str, listed: tuple[str, ...] | None = None) -> None:
    """A folder of several qualities, of which the last one listed takes the least."""
    for name in names:
        (folder / name).mkdir(parents=True)
        (folder / name / "manifest.json").write_text("{}")
    given = names if listed is None else listed
    write_list(folder, [ListedQuality(name, f"{name}/manifest.json", 9.0 - n) for n, name in enumerate(given)])


def test_several_qualities_are_served_when_all_have_a_frame(tmp_path: Path) -> None:
    several(tmp_path / "waits", "high", listed=("high", "low"))
    (tmp_path / "waits" / "low").mkdir()
    several(tmp_path / "elsewhere", "high", "low", listed=("high", "low", "x/low"))
    several(tmp_path / "linked", "high", listed=("high", "low"))
    (tmp_path / "linked" / "low").symlink_to(tmp_path / "waits" / "high")
    several(tmp_path / "broken", "high", "low")
    (tmp_path / "broken" / "qualities.json").write_text("[]")
    several(tmp_path / "one", "low", listed=("low",))
    assert [*Catalog(tmp_path).found()] == ["one"]
    (tmp_path / "waits" / "low" / "manifest.json").touch()
    assert [*Catalog(tmp_path).found()] == ["one", "waits"]


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
    gc.collect()  # what earlier tests dropped
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
