# SPDX-License-Identifier: Apache-2.0
"""The table of parts: each row leaves out the parts that it says and keeps the others."""

from dataclasses import replace

import pytest

from outcomes import outcome
from structgstream.errors import ConfigError
from structgstream.session.presets import COMPACT, PRESETS, to_json
from structgstream_studies.experiments.effects import WHOLE, effects_sheet
from structgstream_studies.experiments.parts import NONE, PARTS, parts
from structgstream_studies.experiments.studies import effect_titles, part_titles, rows_of, variant_titles
from structgstream_studies.experiments.variants import FULL
from test_variants import differing

ROWS = parts(COMPACT)
FIELDS = {name: f"online.{part.field}" for name, part in PARTS.items()}


@pytest.mark.parametrize("key", sorted(ROWS))
def test_a_row_differs_from_the_whole_in_exactly_the_fields_it_names(key: str) -> None:
    row = ROWS[key]
    assert differing(to_json(COMPACT), to_json(row.config)) == row.changes
    assert bool(row.changes) == (key != WHOLE)


@pytest.mark.parametrize("name", sorted(PARTS))
def test_left_out_and_alone_are_opposites(name: str) -> None:
    assert ROWS[f"{WHOLE}-less-{name}"].changes == {FIELDS[name]}
    assert ROWS[f"{WHOLE}-only-{name}"].changes == set(FIELDS.values()) - {FIELDS[name]}
    assert ROWS[NONE].changes == set(FIELDS.values())


@pytest.mark.parametrize("preset", ["compact", "fast", "tiny"])
def test_every_compact_preset_has_all_parts(preset: str) -> None:
    assert parts(PRESETS[preset]).keys() == ROWS.keys()


@pytest.mark.parametrize("key", [key for key, row in ROWS.items() if len(row.changes) == 1])
def test_a_part_that_is_off_already_cannot_be_left_out(key: str) -> None:
    row = ROWS[key]
    with pytest.raises(ConfigError, match=f"leaves out {min(row.changes)}, which is off already"):
        parts(row.config)


def test_a_stream_that_is_not_compact_is_refused() -> None:
    with pytest.raises(ConfigError, match="take --preset compact"):
        parts(replace(COMPACT, codec="raw"))


def test_rows_have_keys_and_titles_of_their_own_beside_the_whole() -> None:
    titles = part_titles()
    assert list(titles) == rows_of("parts") == list(ROWS)
    assert len(set(titles.values())) == len(titles)
    assert titles.keys() & effect_titles().keys() == {WHOLE}
    assert not titles.keys() & variant_titles().keys() - {FULL}


def test_the_sheet_shows_differences_to_everything() -> None:
    found = [outcome(WHOLE, psnr=30.0), outcome(NONE, psnr=28.75), outcome("compact-without-gate", psnr=3.0)]
    sheet = effects_sheet(found, titles=part_titles(), title="Parts")
    rows = {row[0]: dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows}
    assert sheet.title == "Parts"
    assert list(rows) == list(part_titles().values())
    assert rows[f"none of the {len(PARTS)} parts below"]["to compact, dB"] == "-1.25"
    assert rows["motion start alone"]["PSNR, dB"] == "-"
