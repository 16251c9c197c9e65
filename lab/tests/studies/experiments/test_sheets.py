# SPDX-License-Identifier: Apache-2.0
"""Tables: what stands in which cell, what is left out, and that Markdown reads them as tables."""

import re

import pytest

from outcomes import outcome, outcomes
from structgstream_studies.experiments.readings import BASE, READINGS, readings_sheet
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import (
    SCORES,
    Sheet,
    ablation_sheet,
    comparison_sheet,
    format_score,
    markdown,
)
from structgstream_studies.experiments.studies import COMPARED, variant_titles
from structgstream_studies.experiments.summary import Spread
from structgstream_studies.experiments.variants import FULL, TABLES, AblationTable


def cells_of(line: str) -> list[str]:
    """Cells of a line of a table, as Markdown splits it."""
    assert line.startswith("| ")
    assert line.endswith(" |")
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def column(sheet: Sheet, name: str) -> dict[str, str]:
    position = list(sheet.columns).index(name)
    return {row[0]: row[position] for row in sheet.rows}


def structured() -> list[Result]:
    found = outcomes(FULL, (30.0, 31.0, 32.0))
    found += outcomes("without-scaling-factor", (29.8, 30.7, 31.8))
    found += outcomes("without-covariance-mlp", (30.1, 31.2, 32.1))
    return found + outcomes("with-color-mlp", (29.0, 30.0))


def test_ours_the_difference_the_papers_figures_and_what_follows() -> None:
    sheet = ablation_sheet(TABLES["structured"], structured(), titles=variant_titles())
    rows = [dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows]
    assert [row["variant"] for row in rows] == [variant_titles()[key] for key in TABLES["structured"].rows]
    assert rows[0] == {
        "variant": "w/o scaling factor",
        "PSNR, dB": "30.77 ± 1.00",
        "to full, dB": "-0.23 ± 0.06",
        "paper, dB": "33.53",
        "paper to full, dB": "-0.28",
        "the paper's order": "reproduced",
    }
    assert rows[1]["to full, dB"] == "+0.13 ± 0.06"
    assert rows[1]["the paper's order"] == "cannot be decided"
    assert rows[3]["the paper's order"] == "cannot be decided"
    assert rows[4] == {
        "variant": "full method",
        "PSNR, dB": "31.00 ± 1.00",
        "to full, dB": "-",
        "paper, dB": "33.81",
        "paper to full, dB": "-",
        "the paper's order": "-",
    }


def test_a_variant_without_a_result_has_dashes_and_the_papers_figures() -> None:
    sheet = ablation_sheet(TABLES["structured"], structured(), titles=variant_titles())
    assert list(sheet.rows[2]) == ["w opacity MLP", "-", "-", "33.78", "-0.03", "-"]


def test_without_the_full_method_nothing_is_compared() -> None:
    found = [result for result in structured() if result.key != FULL]
    sheet = ablation_sheet(TABLES["structured"], found, titles=variant_titles())
    assert list(sheet.columns) == ["variant", "PSNR, dB", "paper, dB", "paper to full, dB"]


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES.keys())
def test_every_figure_of_the_paper_is_in_the_table(table: AblationTable) -> None:
    sheet = ablation_sheet(table, [outcome(key) for key in table.rows], titles=variant_titles())
    for key, figures in table.rows.items():
        row = next(row for row in sheet.rows if row[0] == variant_titles()[key])
        numbers = [float(cell) for cell in row if re.fullmatch(r"\d+(\.\d+)?", cell)]
        units = {"psnr": 1.0, "free_bytes": 1e-6, "t_lpips": 1e2, "e_warp": 1e3}
        for name, value in figures.items():
            assert any(number == pytest.approx(value * units[name], abs=5e-4) for number in numbers), (key, name)


def test_scores_beside_the_papers_in_the_same_unit() -> None:
    mean = {"online_free_bytes": 2.5e6, "e_warp": 5.1e-3}
    found = [outcome(FULL, psnr=31.0, mean=mean), outcome("without-free", psnr=30.0, mean=mean)]
    sheet = ablation_sheet(TABLES["free"], found, titles=variant_titles())
    assert column(sheet, "free 3DGs, MB a frame")["full method"] == "2.50"
    assert column(sheet, "paper: free 3DGs, MB a frame")["full method"] == "1.40"
    assert column(sheet, "E_warp, 1e-3")["w/o free 3DGs"] == "5.100"
    assert column(sheet, "paper: E_warp, 1e-3")["w/o free 3DGs"] == "4.890"
    assert column(sheet, "E_warp, 1e-3")["random generation"] == "-"
    assert "flicker, 1/255" not in sheet.columns
    assert "T-LPIPS, 1e-2" not in sheet.columns
    assert "paper: T-LPIPS, 1e-2" in sheet.columns


def test_where_the_paper_prints_nothing_its_columns_are_dropped() -> None:
    found = outcomes(FULL, (30.0, 31.0, 32.0)) + outcomes("without-distance", (29.9, 30.8, 31.9))
    sheet = ablation_sheet(TABLES["distance"], found, titles=variant_titles())
    assert list(sheet.columns) == ["variant", "PSNR, dB", "to full, dB", "the paper's order"]
    # Nor do variants have a row that neither it nor a result has a figure of.
    assert [row[0] for row in sheet.rows] == ["w/o distance regularisation", "full method"]
    assert sheet.rows[0][-1] == "cannot be decided"


def test_methods_side_by_side_in_the_order_of_the_titles() -> None:
    found = [*outcomes("b", (30.0, 32.0)), outcome("a", psnr=None, stream={"psnr_first": 35.0})]
    sheet = comparison_sheet(found, titles={"a": "Method A", "c": "Method C", "b": "Method B"}, scores=COMPARED)
    assert list(sheet.columns) == ["method", "seeds", "frame 0, dB", "PSNR, dB"]
    assert [list(row) for row in sheet.rows] == [
        ["Method A", "1", "35.00", "-"],
        ["Method B", "2", "-", "31.00 ± 1.41"],
    ]


def test_the_colour_fit_the_speed_and_the_header_shared_over_the_frames() -> None:
    old = outcome(FULL, stream={"total_bytes": 9_000_000, "decode_and_render_fps": 22.776})
    new = outcome("without-free", mean={"psnr_camera_color": 31.5, "bytes_with_header": 2_000_000.0})
    methods = comparison_sheet([old, new], titles=variant_titles(), scores=COMPARED)
    ablation = ablation_sheet(TABLES["free"], [old, new], titles=variant_titles())
    for sheet in (methods, ablation):
        assert column(sheet, "colour held, dB")["full method"] == "-"
        assert column(sheet, "colour held, dB")["w/o free 3DGs"] == "31.50"
        assert column(sheet, "with the header, MB a frame")["full method"] == "3.00"  # of a file of three frames
        assert column(sheet, "with the header, MB a frame")["w/o free 3DGs"] == "2.00"
        assert column(sheet, "pictures a second")["full method"] == "22.8"
        assert column(sheet, "pictures a second")["w/o free 3DGs"] == "-"


def test_every_tenth_frame_has_no_temporal_scores() -> None:
    scores = {"e_warp": 1e-3, "flicker": 1.5}
    found = [outcome("a", mean=scores), outcome("b", mean=scores, capture={"every": 10})]
    sheet = comparison_sheet(found, titles={"a": "A", "b": "B"}, scores=COMPARED)
    assert column(sheet, "E_warp, 1e-3") == {"A": "1.000", "B": "-"}
    assert column(sheet, "flicker, 1/255") == {"A": "1.500", "B": "-"}
    assert column(sheet, "PSNR, dB") == {"A": "30.00", "B": "30.00"}


def test_a_score_is_written_in_its_unit_with_its_digits() -> None:
    assert format_score(Spread(1.2345e6, 0.0, 1), "online_bytes") == "1.23"
    assert format_score(Spread(1.2345e6, 0.04e6, 3), "online_bytes") == "1.23 ± 0.04"
    assert format_score(Spread(0.5, 0.0, 1), "psnr", signed=True) == "+0.50"
    assert format_score(None, "psnr") == "-"
    assert all(name in SCORES for table in TABLES.values() for name in table.scores)


def sheets() -> dict[str, Sheet]:
    readings = [outcome(key) for key in READINGS]
    return {
        **{key: ablation_sheet(table, structured(), titles=variant_titles()) for key, table in TABLES.items()},
        "methods": comparison_sheet(structured(), titles=variant_titles(), scores=COMPARED),
        "no methods": comparison_sheet([], titles={}, scores=COMPARED),
        "readings": readings_sheet(readings),
        "bars": Sheet("Bars", ["a|b", "c"], [["|", "d"]]),
    }


@pytest.mark.parametrize("name", sheets())
def test_every_table_has_as_many_cells_in_each_line(name: str) -> None:
    sheet = sheets()[name]
    text = markdown(sheet)
    assert text.endswith("|\n")
    head, rule, *rows = [cells_of(line) for line in text.splitlines()]
    assert {len(row) for row in (rule, *rows)} <= {len(head)}
    assert rule[0] == "---"
    assert set(rule[1:]) <= {"---:"}
    assert len(rows) == len(sheet.rows)
    assert [cell.replace("\\|", "|") for cell in head] == list(sheet.columns)


def test_no_title_is_used_twice() -> None:
    titles = [score.title for score in SCORES.values()]
    assert len(set(titles)) == len(titles)
    assert BASE in READINGS
