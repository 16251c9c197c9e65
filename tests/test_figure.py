# SPDX-License-Identifier: Apache-2.0
"""What all plots share: a figure of a size, axes without ornament, one sentence where it cannot be stored."""

import sys
from pathlib import Path

import pytest

from structgstream.errors import MissingExtraError, StorageError
from structgstream.figure import figure_of, save_figure, without_frame
from tests.support.drawn import pixels_of


def test_a_figure_has_its_size_and_makes_its_folder(tmp_path: Path) -> None:
    figure = figure_of(2.0, 1.0)
    axis = figure.subplots()
    without_frame(axis)
    assert not axis.spines["top"].get_visible()
    assert axis.spines["left"].get_visible()
    save_figure(figure, tmp_path / "new" / "x.png")
    assert pixels_of(tmp_path / "new" / "x.png").shape == (110, 220, 3)


def test_a_letter_that_the_font_lacks_is_no_warning(tmp_path: Path) -> None:
    figure = figure_of(1.0, 1.0)
    figure.text(0.5, 0.5, "\N{CJK UNIFIED IDEOGRAPH-4E8C}")
    save_figure(figure, tmp_path / "x.png")
    assert (tmp_path / "x.png").is_file()


def test_what_is_in_the_way_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        save_figure(figure_of(1.0, 1.0), tmp_path / "file" / "x.png")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match="report"):
        figure_of(1.0, 1.0)
