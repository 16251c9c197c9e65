# SPDX-License-Identifier: Apache-2.0
"""The streams of a folder."""

from pathlib import Path

import pytest

from structgstream.codec.segments.quality_list import ListedQuality, write_list
from structgstream.errors import PlayerError
from structgstream.serve.streams import REFRESH_SECONDS, Catalog, StreamKind


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


def test_files_beside_a_stream_are_named_after_it(tmp_path: Path) -> None:
    (tmp_path / "ball.sgs").touch()
    (tmp_path / "studio").mkdir()
    (tmp_path / "studio" / "manifest.json").touch()
    for name in ("ball", "studio"):
        (tmp_path / f"{name}.metrics.json").write_text(name)
    for name, stream in Catalog(tmp_path).found().items():
        opened = stream.open_beside(".metrics.json")
        assert opened is not None
        with opened:
            assert opened[:].decode() == name.removesuffix(".sgs")


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
