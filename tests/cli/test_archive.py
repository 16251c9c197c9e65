# SPDX-License-Identifier: Apache-2.0
"""The command ``archive``."""

import os
from pathlib import Path

import pytest

from structgstream.cli import main
from tests.support.quick_streams import error_of
from tests.support.segment_folders import GrowingFolder
from tests.support.streams import small_stream

STREAM = small_stream(4)


@pytest.fixture
def studio(tmp_path: Path) -> Path:
    GrowingFolder(tmp_path / "studio", STREAM).write_all()
    return tmp_path / "studio"


def test_what_is_told_of_the_file(studio: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["archive", str(studio), "-o", str(tmp_path / "[b]all.sgs")]) == 0
    assert (tmp_path / "[b]all.sgs").read_bytes() == STREAM
    assert capsys.readouterr().out.startswith(f"Wrote {tmp_path / '[b]all.sgs'}: 4 frames, 3")
    growing = GrowingFolder(tmp_path / "one", STREAM)
    growing.write()
    assert main(["archive", str(tmp_path / "one"), "-o", str(tmp_path / "one.sgs")]) == 0
    assert ": 1 frame, " in capsys.readouterr().out


def test_a_file_that_is_there_stays(studio: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ball.sgs"
    out.write_bytes(b"precious")
    command = ["archive", str(studio), "-o", str(out)]
    assert "replace it with --overwrite, or choose another name" in error_of(command, capsys, status=2)
    assert out.read_bytes() == b"precious"
    (studio / "manifest.json").rename(studio / "x")
    assert "has no manifest.json" in error_of([*command, "--overwrite"], capsys, status=1)
    assert out.read_bytes() == b"precious"
    (studio / "x").rename(studio / "manifest.json")
    assert main([*command, "--overwrite"]) == 0
    assert out.read_bytes() == STREAM


def test_what_is_no_folder_of_segments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    for wrong in (tmp_path / "file", tmp_path / "none"):
        assert str(wrong) in error_of(["archive", str(wrong), "-o", str(tmp_path / "x.sgs")], capsys, status=1)
    assert os.listdir(tmp_path) == ["file"]
