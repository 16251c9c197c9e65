# SPDX-License-Identifier: Apache-2.0
"""Which streams a folder holds, and opening files below it."""

import os
from pathlib import Path

import pytest

from structgstream.errors import PlayerError
from structgstream.server.catalog import LOOK_AGAIN_SECONDS, Catalog, StreamKind
from structgstream.server.files import open_below
from structgstream.server.names import hash_in_name, is_plain_path, is_stream_name


def test_what_is_a_stream(tmp_path: Path) -> None:
    for name in ("b.sgs", "a.SGS", "c.sgs.partial", ".hidden.sgs", "a b.sgs", "ä.sgs"):
        (tmp_path / name).touch()
    for name in ("studio", "empty", ".dot", "z.sgs"):
        (tmp_path / name).mkdir()
    for name in ("studio", ".dot"):
        (tmp_path / name / "manifest.json").touch()
    catalog = Catalog(tmp_path)
    assert [(name, one.kind) for name, one in catalog.found.items()] == [
        ("b.sgs", StreamKind.FILE),
        ("studio", StreamKind.SEGMENTS),
    ]
    assert set(catalog.unnamed) == {"a b.sgs", "ä.sgs"}


def test_it_looks_again_after_a_second(tmp_path: Path) -> None:
    seconds = 0.0
    catalog = Catalog(tmp_path, clock=lambda: seconds)
    (tmp_path / "new.sgs").touch()
    assert not catalog.stale
    catalog.look()
    assert not catalog.found
    seconds = LOOK_AGAIN_SECONDS
    assert catalog.stale
    catalog.look()
    assert set(catalog.found) == {"new.sgs"}
    assert not catalog.stale


def test_what_is_no_folder(tmp_path: Path) -> None:
    with pytest.raises(PlayerError, match="cannot be read"):
        Catalog(tmp_path / "none")
    (tmp_path / "file.sgs").touch()
    with pytest.raises(PlayerError, match=rf"is a file; serve takes a folder of streams: {tmp_path}"):
        Catalog(tmp_path / "file.sgs")


def test_the_folder_itself_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.sgs").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    stream = Catalog(tmp_path / "link").found["a.sgs"]
    opened = stream.open_whole()
    assert opened is not None
    with opened:
        assert opened[:] == b"x"


def test_files_beside_a_stream_are_named_after_it(tmp_path: Path) -> None:
    (tmp_path / "ball.sgs").touch()
    (tmp_path / "studio").mkdir()
    (tmp_path / "studio" / "manifest.json").touch()
    for name in ("ball", "studio"):
        (tmp_path / f"{name}.metrics.json").write_text(name)
    for name, stream in Catalog(tmp_path).found.items():
        opened = stream.open_beside(".metrics.json")
        assert opened is not None
        with opened:
            assert opened[:].decode() == name.removesuffix(".sgs")


def test_bytes_of_a_file_that_becomes_shorter(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(bytes(range(100)))
    opened = open_below(tmp_path, "file")
    assert opened is not None
    with opened:
        os.truncate(tmp_path / "file", 10)
        assert len(opened) == 100
        assert opened.read(5, 50) == bytes(range(5, 10))
        assert opened.read(50, 5) == b""


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
