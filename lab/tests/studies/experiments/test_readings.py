# SPDX-License-Identifier: Apache-2.0
"""Each reading of the paper is another configuration, and stands beside the default."""

import pytest

from outcomes import outcome, outcomes
from structgstream.session.presets import PAPER, RIG, StreamConfig, to_json
from structgstream_studies.experiments.readings import BASE, READINGS, readings_sheet
from tests.support.small_presets import TINY_RIG


@pytest.mark.parametrize("config", [PAPER, RIG, TINY_RIG], ids=["paper", "rig", "tiny"])
def test_every_reading_but_the_default_changes_the_configuration_in_a_way_of_its_own(config: StreamConfig) -> None:
    edited = {key: str(to_json(reading.edit(config))) for key, reading in READINGS.items()}
    assert edited.pop(BASE) == str(to_json(config))
    assert str(to_json(config)) not in edited.values()
    assert len(set(edited.values())) == len(edited)


def test_readings_keep_the_seed_and_what_they_are_not_about() -> None:
    for key, reading in READINGS.items():
        edited = reading.edit(RIG)
        assert edited.seed == RIG.seed
        assert edited.online.iterations == RIG.online.iterations, key
        assert edited.initial.iterations == RIG.initial.iterations, key
    assert READINGS["reading-no-distance"].edit(RIG).initial.distance_input is not RIG.initial.distance_input
    assert READINGS["reading-l1"].edit(RIG).initial.losses.l1 == 0.8
    assert READINGS["reading-l1"].edit(RIG).online.losses.l1 == 0.8
    assert "base_scales" in READINGS["reading-base-scales"].edit(RIG).online.dynamic


def test_the_table_has_the_readings_that_were_run_beside_the_default() -> None:
    found = [*outcomes(BASE, (30.0, 31.0)), *outcomes("reading-l1", (30.5, 31.3)), outcome("full", psnr=99.0)]
    sheet = readings_sheet(found)
    assert list(sheet.columns) == [
        "question",
        "reading",
        "frame 0, dB",
        "PSNR, dB",
        "colour held, dB",
        "changed, dB",
        "to the default, dB",
    ]
    assert [list(row) for row in sheet.rows] == [
        ["-", "the defaults", "-", "30.50 ± 0.71", "-", "-", "-"],
        ["the weight of L1", "0.8, as Scaffold-GS's code", "-", "30.90 ± 0.57", "-", "-", "+0.40 ± 0.14"],
    ]


def test_without_the_default_nothing_is_compared() -> None:
    assert [row[-1] for row in readings_sheet(outcomes("reading-l1", (30.5,))).rows] == ["-"]
    assert readings_sheet([]).rows == []
