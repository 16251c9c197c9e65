# SPDX-License-Identifier: Apache-2.0
"""The commands prepare and board, as a user types them."""

import json
import os
import re
from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.options import Distance, PrepareOptions, parse_board
from structgstream.preparation.output_folder import mark_output
from tests.support.quick_preparation import quicken
from tests.support.quick_streams import Runner
from tests.support.rooms import write_room


def test_prepare_then_check_and_a_mistake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner) -> None:
    quicken(monkeypatch)
    write_room(tmp_path / "videos")
    out = tmp_path / "out"
    command = ["prepare", str(tmp_path / "videos"), "-o", str(out), "--synchronize", "none", "--held-out", "cam02"]
    message = run(command).out
    assert "calibrate    cameras.json: 5 cameras" in message
    assert "add cameras, or move them closer together. The check found no error; see the warnings." in " ".join(
        message.split()
    )
    file = out / "capture.json"
    content = json.loads(file.read_text())
    assert content["held_out"] == ["cam02"]
    for entry in content["cameras"].values():
        entry["viewmat"] = [[entry["viewmat"][j][i] for j in range(3)] + [0.1] for i in range(3)] + [[0, 0, 0, 1]]
    file.write_text(json.dumps(content))
    assert (
        "structgstream: " in run(["prepare", "--check", str(out), "--report", str(tmp_path / "report")], status=1).err
    )
    assert (tmp_path / "report" / "index.html").is_file()


def test_wrong_usage(tmp_path: Path, run: Runner) -> None:
    out = ["-o", str(tmp_path / "out")]
    assert "-o CAPTURE" in run(["prepare", str(tmp_path)], status=2).err
    assert "WIDTHxHEIGHT" in run(["prepare", str(tmp_path), *out, "--size", "720p"], status=2).err
    for ignored in (out, ["--lens", "brown"]):
        error = run(["prepare", "--check", str(tmp_path), *ignored], status=2).err
        assert "it takes --report alone" in " ".join(error.split())
    report = ["--report", str(tmp_path / "report")]
    assert "--report goes with --check" in run(["prepare", str(tmp_path), *out, *report], status=2).err
    assert "is missing; give the folder" in run(["prepare", str(tmp_path / "nowhere"), *out], status=1).err


def test_every_option_arrives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[PrepareOptions] = []

    def note(videos: Path, capture: Path, *, options: PrepareOptions, listener: object) -> None:
        asked.append(options)
        raise KeyboardInterrupt

    monkeypatch.setattr("structgstream.preparation.prepare.prepare_capture", note)
    command = f"prepare {tmp_path} -o {tmp_path / 'out'} --calibration board --board 9x6:80mm --board-videos {tmp_path}"
    command += " --lens fisheye --intrinsics shared --refine --distance a b 3.2m --synchronize audio --near 0.2"
    command += " --field-of-view 90 --size 64x48 --held-out a b --fps 25 --without c --link copy"
    assert main(command.split()) == 130
    assert asked == [
        PrepareOptions(
            calibration="board", board=Board(9, 6, 0.08), board_videos=tmp_path, lens="fisheye", intrinsics="shared",
            refine=True, distance=Distance("a", "b", 3.2), synchronize="audio", near=0.2, field_of_view=90,
            size=(64, 48), held_out=("a", "b"), fps=25, without=("c",), link="copy",
        )
    ]  # fmt: skip


HIDDEN, READ_ONLY = 0, 0o555


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read and write everything")
@pytest.mark.parametrize(
    ("place", "mode", "said"),
    [
        ("videos/cam02.mp4", HIDDEN, "The video {place} cannot be opened (Permission denied); let yourself read it."),
        (
            "videos/cameras.json",
            HIDDEN,
            "{place} cannot be read (Permission denied); expected width, height and cameras",
        ),
        ("videos", HIDDEN, "no permission for {place}; change its permissions"),
        ("videos/masks", HIDDEN, "no permission for {place}; change its permissions"),
        ("out", HIDDEN, "no permission for {place}"),
        ("out", READ_ONLY, "The folder {place} cannot be written (Permission denied)."),
        ("out/work", READ_ONLY, "The folder {folder}/out cannot be written (Permission denied)."),
    ],
)
def test_what_may_not_be_read_or_written(tmp_path: Path, place: str, mode: int, said: str, run: Runner) -> None:
    """One sentence that names it, and nothing of the input is changed."""
    write_room(tmp_path / "videos")
    for folder in ("videos/masks", "out"):
        (tmp_path / folder).mkdir()
    if place == "out/work":
        mark_output(tmp_path / "out", tmp_path / "videos")
    before = {path: path.read_bytes() for path in (tmp_path / "videos").iterdir() if path.is_file()}
    path = tmp_path / place
    usual = path.stat().st_mode
    path.chmod(mode)
    try:
        command = ["prepare", str(tmp_path / "videos"), "-o", str(tmp_path / "out"), "--synchronize", "none"]
        error = run(command, status=1).err
    finally:
        path.chmod(usual)
    assert error.removeprefix("structgstream: ").startswith(said.format(place=path, folder=tmp_path))
    assert error.count("\n") == 1
    assert {path: path.read_bytes() for path in before} == before


def test_what_is_printed_names_the_board_for_prepare(tmp_path: Path, run: Runner) -> None:
    """The command that is shown, typed, is this board."""
    given = ["--paper", "A0", "--squares", "9x6", "--square", "7.5cm", "--dictionary", "DICT_4X4_250"]
    shown = re.search(r"--board (\S+)", run(["board", "-o", str(tmp_path / "new" / "b.pdf"), *given]).out)
    assert (tmp_path / "new" / "b.pdf").read_bytes().startswith(b"%PDF")
    assert shown
    assert parse_board(shown[1]) == Board(9, 6, 0.075, dictionary="DICT_4X4_250")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--squares", "7"], "COLUMNSxROWS"),
        (["--squares", "5x5"], "looks alike when turned"),
        (["--square", "0mm"], "0mm"),
        (["--square", "nan"], "nan"),
        (["--square", "900mm"], "A3"),
        (["--dictionary", "DICT_9X9"], "DICT_9X9"),
        (["--squares", "1x1"], "1 x 1"),
        (["--paper", "B5"], "B5"),
    ],
)
def test_what_is_no_board(tmp_path: Path, given: list[str], words: str, run: Runner) -> None:
    assert words in run(["board", "-o", str(tmp_path / "b.pdf"), *given], status=2).err
    assert not (tmp_path / "b.pdf").exists()
