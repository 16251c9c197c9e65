# SPDX-License-Identifier: Apache-2.0
"""What is cited of the paper: marked as cited, as printed, and reported of which data."""

import re

import pytest

from outcomes import outcome
from structgstream.errors import ConfigError
from structgstream_studies.experiments.cited import CITED, cited_sheet, dataset_sheet
from structgstream_studies.experiments.documents import refresh_text
from structgstream_studies.experiments.results import Result


@pytest.mark.parametrize("name", CITED)
def test_a_cited_table_says_that_it_is_cited_and_of_what(name: str) -> None:
    text = refresh_text(f"<!-- cited {name} -->\n<!-- end -->\n", {})
    assert "**Cited from the paper, not measured here:**" in text
    assert CITED[name].data in text
    assert "| cited method |" in text
    assert refresh_text(text, {}) == text


@pytest.mark.parametrize("name", CITED)
def test_every_figure_is_a_number_and_every_online_method_has_its_initial_model(name: str) -> None:
    sheet = cited_sheet(name)
    for row, cells in zip(CITED[name].rows, sheet.rows, strict=True):
        assert all(re.fullmatch(r"\d+(\.\d+)?", cell) for cell in cells[2:] if cell != "-")
        assert (row.with_initial != "-") == (row.kind == "online")
        if row.kind == "online":
            assert float(row.with_initial) > float(row.megabytes)
    assert len({row[0] for row in sheet.rows}) == len(sheet.rows)


def test_the_papers_own_rows_are_as_printed() -> None:
    own = {name: next(row for row in cited_sheet(name).rows if row[0] == "Struct-GStream")[2:] for name in CITED}
    assert own == {
        "n3dv": ["31.72", "4.7", "4.8", "0.14", "120"],
        "meetroom": ["30.95", "2.97", "3.02", "0.08", "123"],
        "immersive": ["28.48", "5.2", "5.4", "0.26", "96"],
    }


def test_our_row_is_the_mean_over_captures_of_the_means_over_seeds() -> None:
    def of(name: str, psnr: float, seed: int) -> Result:
        facts = {"online_bytes": 2e6, "bytes_with_header": 3e6, "online_seconds": 6.0}
        return outcome(
            "full", seed, psnr=psnr, mean=facts, stream={"decode_and_render_fps": 50.4}, capture={"name": name}
        )

    results = [of("coffee", 30.0, 0), of("coffee", 31.0, 1), of("steak", 33.5, 0)]
    sheet = dataset_sheet("meetroom", results, name="paper-meetroom")
    ours = ["32.00", "2.00", "3.00", "0.10", "50"]
    assert sheet.rows[-1] == ["ours: paper-meetroom, 2 captures (coffee, steak)", "online", *ours]
    assert sheet.rows[-2] == ["cited: Struct-GStream", "online", "30.95", "2.97", "3.02", "0.08", "123"]
    assert dataset_sheet("meetroom", [], name="x").rows[-1][2:] == ["-"] * 5


def test_what_is_not_cited() -> None:
    with pytest.raises(ConfigError, match="'arc'; there are n3dv, meetroom, immersive"):
        refresh_text("<!-- cited arc -->\n<!-- end -->\n", {})
