# SPDX-License-Identifier: Apache-2.0
"""The curve of the compact stream: its points, what lies beside it, and what is said where nothing can be."""

import pytest

from outcomes import outcome
from structgstream.errors import ConfigError
from structgstream.session.presets import COMPACT, RIG, to_json
from structgstream_studies.experiments.rate_distortion import (
    QUALITIES,
    bd_sheet,
    bullet_list,
    curve_of,
    curve_titles,
    qualities,
    quality_key,
    rates_sheet,
    versus_sheet,
)
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.summary import summaries
from structgstream_studies.experiments.variants import FULL
from test_variants import differing

KEYS = ["quality-m2", "quality-m1", "compact", "quality-p1", "quality-p2"]


def point(key: str, rate: float, psnr: float, *, seed: int = 0) -> Result:
    """``rate`` in kilobytes a frame; changed pixels are 4 dB worse."""
    mean = {"online_bytes": 1e3 * rate, "psnr_camera_color": psnr + 1, "psnr_changed": psnr - 4.0, "flicker": 0.5}
    mean["bytes_with_header"] = 1e3 * rate + 3e5
    return outcome(key, seed, psnr=psnr, mean=mean, stream={"decode_and_render_fps": 25.0})


def curve(*, factor: float = 1.0, shift: float = 0.0, seed: int = 0) -> list[Result]:
    """Twice the bytes for half a decibel: a line over the logarithm of the rate."""
    return [point(key, factor * 4.0 * 2.0**i, 30.0 + shift + 0.5 * i, seed=seed) for i, key in enumerate(KEYS)]


def test_points_differ_in_the_quality_alone_and_the_middle_is_the_stream_itself() -> None:
    rows = qualities(COMPACT)
    assert list(rows) == KEYS == [quality_key(quality) for quality in QUALITIES]
    assert [row.config.online.rounding.quality for row in rows.values()] == [-2, -1, 0, 1, 2]
    assert rows["compact"].config == COMPACT
    for key, row in rows.items():
        assert differing(to_json(COMPACT), to_json(row.config)) == row.changes
        assert bool(row.changes) == (key != "compact")
    with pytest.raises(ConfigError, match="codec 'compact'"):
        qualities(RIG)


def test_points_and_the_methods_beside_them() -> None:
    paper = point(FULL, 1730.0, 30.2)
    found = [*curve(), *curve(shift=0.2, seed=1), paper, point("3dgs", 1e4, 31.0)]
    sheet = rates_sheet([result for result in found if result.key != "quality-p1"])
    rows = {row[0]: list(row[1:]) for row in sheet.rows}
    assert list(rows) == [title for title in curve_titles().values() if title != "3DGStream's method"]
    costs = ["304.0 ± 0.0", "0.500 ± 0.000", "25.0 ± 0.0"]
    assert rows["compact, quality -2"][:4] == ["2", "30.10 ± 0.14", "31.10 ± 0.14", "26.10 ± 0.14"]
    assert rows["compact, quality -2"][4:] == ["4.0 ± 0.0", "0.96", *costs]
    assert rows["paper mode"] == ["1", "30.20", "31.20", "26.20", "1730.0", "415.20", "2030.0", "0.500", "25.0"]
    assert set(rows["compact, quality +1"]) == {"-"}
    assert all(len(row) == len(sheet.columns) for row in sheet.rows)


def test_a_study_without_results_has_dashes() -> None:
    sheet = rates_sheet([])
    assert len(sheet.rows) == len(QUALITIES)
    assert {cell for row in sheet.rows for cell in row[1:]} == {"-"}
    versus, remarks = versus_sheet([])
    assert versus.rows == remarks == []


def test_a_method_on_the_curves_quality_and_rate() -> None:
    sheet, remarks = versus_sheet([*curve(), point("3dgstream", 32.0, 30.5)])
    assert list(sheet.columns)[4:] == [
        "curve at its quality, KB a frame",
        "to its, %",
        "curve at its rate, dB",
        "to its, dB",
    ]
    assert list(sheet.rows[0]) == ["3DGStream's method, PSNR", "1", "32.0", "30.50", "8.0", "-75.0", "31.50", "+1.00"]
    assert list(sheet.rows[1][5:]) == ["-75.0", "27.50", "+1.00"]
    assert remarks == []


@pytest.mark.parametrize(
    ("rate", "psnr", "words"),
    [
        (1730.0, 29.1, ["29.10 dB are not on the curve, which begins at 30.00 dB", "ends at 64.0 KB"]),
        (3.0, 33.0, ["33.00 dB are not on the curve, which ends at 32.00 dB", "begins at 4.0 KB"]),
    ],
)
def test_a_method_beyond_the_curve_has_dashes_and_a_sentence(rate: float, psnr: float, words: list[str]) -> None:
    sheet, remarks = versus_sheet([*curve(), point(FULL, rate, psnr)])
    assert list(sheet.rows[0][4:]) == ["-"] * 4
    mine = [remark for remark in remarks if remark.startswith("paper mode, PSNR:")]
    assert len(mine) == 2
    assert all(word in remark for word, remark in zip(words, mine))


def test_only_seeds_that_all_points_have_are_compared() -> None:
    found = [*curve(), *curve(shift=1.0, seed=1)[:-1], point(FULL, 32.0, 30.5), point(FULL, 32.0, 99.0, seed=1)]
    sheet, _ = versus_sheet(found)
    assert list(sheet.rows[0][1:4]) == ["1", "32.0", "30.50"]
    sheet, _ = versus_sheet([*curve(), point(FULL, 32.0, 30.5, seed=7)])
    assert sheet.rows == []


def test_a_single_point_is_no_curve() -> None:
    sheet, remarks = versus_sheet([curve()[2], point(FULL, 32.0, 30.5)])
    assert list(sheet.rows[0][4:]) == ["-"] * 4
    assert "paper mode, PSNR: The curve has 1 points, two are needed." in remarks


def test_points_that_others_better_are_left_out_and_named() -> None:
    found = [result for result in curve() if result.key != "quality-p2"] + [point("quality-p2", 64.0, 31.2)]
    points, remarks = curve_of(summaries(found), "psnr", {0})
    assert [rate for rate, _ in points] == pytest.approx([4.0, 8.0, 16.0, 32.0])
    assert len(remarks) == 1
    assert "quality +2" in remarks[0]
    same_rate = [point("quality-m2", 4.0, 30.0), point("quality-m1", 4.0, 30.5), point("compact", 9.0, 31.0)]
    points, _ = curve_of(summaries(same_rate), "psnr", {0})
    assert [quality for _, quality in points] == [30.5, 31.0]


def test_one_curve_against_another() -> None:
    sheet, remarks = bd_sheet(curve(factor=0.5), [*curve(), *curve(seed=1)])
    assert [list(row) for row in sheet.rows] == [
        ["PSNR", "1", "-50.0", "+0.50"],
        ["PSNR of changed pixels", "1", "-50.0", "+0.50"],
    ]
    assert remarks == []


def test_curves_that_share_nothing_have_dashes_and_a_sentence() -> None:
    sheet, remarks = bd_sheet(curve(shift=50.0), curve())
    assert {cell for row in sheet.rows for cell in row[2:]} == {"-"}
    assert remarks[0].startswith("PSNR: ")
    assert "share no quality" in remarks[0]
    assert len(remarks) == 2


def test_sentences_as_a_list() -> None:
    assert bullet_list([]) == ""
    assert bullet_list(["One.", "Two."]) == "\n- One.\n- Two.\n"
