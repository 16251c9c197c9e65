# SPDX-License-Identifier: Apache-2.0
"""A second fold of held-out cameras: chosen by where cameras stand, shown beside the first."""

import pytest

from outcomes import outcome, outcomes
from structgstream.errors import ConfigError
from structgstream_studies.experiments.documents import refresh_text
from structgstream_studies.experiments.folds import even_cameras, folds_sheet
from structgstream_studies.experiments.variants import FULL
from tests.support.rigs import arc_rig

SECOND = {"held_out": ["c", "d"], "scored": ["c", "d"]}


def test_cameras_are_spread_over_the_rig() -> None:
    rig = arc_rig(9)
    assert even_cameras(rig, 1, besides=()) == ("cam04",)
    assert even_cameras(rig, 3, besides=()) == ("cam01", "cam04", "cam07")
    assert even_cameras(rig, 3, besides=("cam00", "cam01", "cam04"))[:2] == ("cam02", "cam05")
    assert even_cameras(rig, 9, besides=()) == tuple(rig)


def test_what_cannot_be_held_out_is_said() -> None:
    rig = arc_rig(4)
    with pytest.raises(ConfigError, match="no camera 'cam09'"):
        even_cameras(rig, 1, besides=("cam09",))
    with pytest.raises(ConfigError, match="3 of 2 cameras"):
        even_cameras(rig, 3, besides=("cam01", "cam02"))
    with pytest.raises(ConfigError, match="ask for 1 to 4"):
        even_cameras(rig, 0, besides=())


def test_each_method_has_a_row_for_each_fold_and_its_difference_to_paper_mode() -> None:
    first = [*outcomes(FULL, (30.0, 31.0)), *outcomes("compact", (30.5, 31.7))]
    second = [outcome(FULL, psnr=28.0, capture=SECOND, mean={"psnr_camera_color": 33.0})]
    sheet = folds_sheet([first, second], titles={FULL: "paper mode", "held": "held", "compact": "compact"})
    rows = [dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows]
    assert [(row["method"], row["fold"], row["held out"]) for row in rows] == [
        ("paper mode", "1", "a, b"),
        ("paper mode", "2", "c, d"),
        ("compact", "1", "a, b"),
        ("compact", "2", "-"),
    ]
    assert [row["PSNR, dB"] for row in rows] == ["30.50 ± 0.71", "28.00", "31.10 ± 0.85", "-"]
    assert [row["colour held, dB"] for row in rows] == ["-", "33.00", "-", "-"]
    assert [row["to paper mode, dB"] for row in rows] == ["-", "-", "+0.60 ± 0.14", "-"]


def test_a_document_shows_both_folds() -> None:
    studies = {"ring": [outcome(FULL)], "ring-fold2": [outcome(FULL, psnr=28.0, capture=SECOND)]}
    text = refresh_text("<!-- folds ring ring-fold2 -->\n<!-- end -->\n", studies)
    assert "| Struct-GStream (rig) | 1 | a, b | 1 | - | 30.00 |" in text
    assert "| Struct-GStream (rig) | 2 | c, d | 1 | - | 28.00 |" in text
    assert refresh_text(text, studies) == text
