# SPDX-License-Identifier: Apache-2.0
"""What is cited of the paper: marked as cited, as printed, and reported of which data."""

import re

import pytest

from structgstream.errors import ConfigError
from structgstream_studies.experiments.cited import CITED, cited_sheet
from structgstream_studies.experiments.documents import refresh_text


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


def test_what_is_not_cited() -> None:
    with pytest.raises(ConfigError, match="'arc'; there are n3dv, meetroom, immersive"):
        refresh_text("<!-- cited arc -->\n<!-- end -->\n", {})
