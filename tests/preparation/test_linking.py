# SPDX-License-Identifier: Apache-2.0
import os
import shutil
from pathlib import Path

import pytest

from structgstream.errors import StorageError
from structgstream.preparation.output_folder import Link, link, remove_others, unlink


def test_each_kind_of_link(tmp_path: Path) -> None:
    source = tmp_path / "a.mp4"
    source.write_text("film")
    link(source, tmp_path / "hard" / "a.mp4", how="hard")
    link(source, tmp_path / "soft" / "a.mp4", how="symlink")
    link(source, tmp_path / "copy" / "a.mp4", how="copy")
    assert (tmp_path / "hard" / "a.mp4").samefile(source)
    assert (tmp_path / "soft" / "a.mp4").is_symlink()
    assert (tmp_path / "copy" / "a.mp4").read_text() == "film"
    assert not (tmp_path / "copy" / "a.mp4").samefile(source)


def test_what_is_there_stays_and_what_changed_is_renewed(tmp_path: Path) -> None:
    source, target = tmp_path / "a.mp4", tmp_path / "copy" / "a.mp4"
    source.write_text("film")
    link(source, target, how="copy")
    inode = target.stat().st_ino
    link(source, target, how="copy")
    assert target.stat().st_ino == inode
    source.write_text("another film")
    link(source, target, how="copy")
    assert target.read_text() == "another film"
    link(source, target, how="hard")
    assert target.read_text() == "another film"


def test_a_link_that_cannot_be_made_is_a_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(source: Path, target: Path) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refused)
    (tmp_path / "a").write_text("film")
    link(tmp_path / "a", tmp_path / "b" / "a", how="hard")
    assert (tmp_path / "b" / "a").read_text() == "film"


def test_folders_come_file_by_file(tmp_path: Path) -> None:
    (tmp_path / "cam").mkdir()
    for number in range(3):
        (tmp_path / "cam" / f"{number}.png").write_text(str(number))
    link(tmp_path / "cam", tmp_path / "out" / "cam", how="hard")
    assert sorted(file.name for file in (tmp_path / "out" / "cam").iterdir()) == ["0.png", "1.png", "2.png"]


def test_no_room_is_told(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("film")
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot be linked or copied to .*--link symlink"):
        link(tmp_path / "a", tmp_path / "file" / "a", how="hard")


@pytest.mark.parametrize("kind", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_copy_that_is_broken_off_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: BaseException
) -> None:
    def cut(source: Path, target: Path) -> None:
        target.write_bytes(source.read_bytes()[:2])
        raise kind

    monkeypatch.setattr(shutil, "copy2", cut)
    (tmp_path / "a").write_text("film")
    with pytest.raises((StorageError, KeyboardInterrupt)):
        link(tmp_path / "a", tmp_path / "b" / "a", how="copy")
    assert not list((tmp_path / "b").iterdir())


def test_what_was_brought_and_is_no_more_goes(tmp_path: Path) -> None:
    for name in ("0.png", "1.png"):
        (tmp_path / name).write_text("film")
    remove_others(tmp_path, ["1.png"])
    assert [file.name for file in tmp_path.iterdir()] == ["1.png"]


@pytest.mark.parametrize("how", ["hard", "symlink", "copy"])
def test_what_was_brought_can_be_taken_back(tmp_path: Path, how: Link) -> None:
    (tmp_path / "cam").mkdir()
    (tmp_path / "cam" / "0.png").write_text("mask")
    link(tmp_path / "cam", tmp_path / "out" / "cam", how=how)
    (tmp_path / "out" / "cam" / "1.png").write_text("by hand")
    unlink(tmp_path / "cam", tmp_path / "out" / "cam")
    assert [file.name for file in (tmp_path / "out" / "cam").iterdir()] == ["1.png"]
    (tmp_path / "out" / "cam" / "1.png").unlink()
    unlink(tmp_path / "cam", tmp_path / "out" / "cam")
    assert not (tmp_path / "out" / "cam").exists()
    assert (tmp_path / "cam" / "0.png").is_file()
