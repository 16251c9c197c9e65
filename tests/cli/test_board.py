# SPDX-License-Identifier: Apache-2.0
"""The command ``board``."""

import re
from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.options import parse_board
from tests.support.quick_streams import error_of


def test_what_is_printed_names_the_board_for_prepare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command that is shown, typed, is this board."""
    given = ["--paper", "A0", "--squares", "9x6", "--square", "7.5cm", "--dictionary", "DICT_4X4_250"]
    assert main(["board", "-o", str(tmp_path / "new" / "b.pdf"), *given]) == 0
    assert (tmp_path / "new" / "b.pdf").read_bytes().startswith(b"%PDF")
    shown = re.search(r"--board (\S+)", capsys.readouterr().out)
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
def test_what_is_no_board(tmp_path: Path, given: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert words in error_of(["board", "-o", str(tmp_path / "b.pdf"), *given], capsys, status=2)
    assert not (tmp_path / "b.pdf").exists()
