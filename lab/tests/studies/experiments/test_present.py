# SPDX-License-Identifier: Apache-2.0
"""A table of results that are not of today's configuration is refused, unless its marker says so."""

from dataclasses import replace
from typing import Any

import pytest

from outcomes import outcome
from structgstream.errors import ConfigError
from structgstream.session.presets import PAPER_METHOD_PRESET, PRESETS, to_json
from structgstream_studies.experiments.documents import refresh_text
from structgstream_studies.experiments.present import former
from structgstream_studies.experiments.results import Result, round_floats
from structgstream_studies.experiments.variants import FULL_METHODS, variants

TABLE = "<!-- ablation structured ring{} -->\n<!-- end -->\n"


def recorded(key: str = "full", **others: Any) -> Result:
    """A result as a run of today would record it, but for what ``others`` replaces at the top of its configuration."""
    config = to_json(variants(replace(PRESETS[PAPER_METHOD_PRESET], seed=2))[key].config)
    found = outcome(key)
    return replace(found, identity={**found.identity, "config": round_floats(config) | others})


def grown(anchors: int) -> Result:
    initial = round_floats(to_json(PRESETS[PAPER_METHOD_PRESET]))["initial"]
    return recorded(initial=initial | {"growth": {**initial["growth"], "max_anchors": anchors}})


def table(marker: str, *results: Result) -> str:
    return refresh_text(TABLE.format(marker), {"ring": list(results)})


def test_results_of_today_whatever_their_seed_are_shown_without_a_remark() -> None:
    shown = [recorded(), recorded("without-scaling-factor")]
    assert not former(shown)
    assert "former" not in table("", *shown)


def test_a_study_may_edit_another_method_which_the_table_names_but_not_two() -> None:
    def edited(key: str) -> Result:
        found = outcome(key)
        config = round_floats(to_json(variants(FULL_METHODS["paper-n3dv, l_v as six scales"])[key].config))
        return replace(found, identity={**found.identity, "config": config})

    six = [edited("full"), edited("without-covariance-mlp"), edited("without-scaling-factor")]
    assert "The full method is paper-n3dv, l_v as six scales." in table("", *six)
    assert "The full method is rig." in table("", recorded())
    with pytest.raises(ConfigError, match=r"initial\.voxel_size"):
        table("", *six, recorded("with-color-mlp"))


def test_another_value_is_refused_and_the_marker_that_accepts_it_is_proposed() -> None:
    with pytest.raises(ConfigError, match=r"<!-- ablation structured ring former initial\.growth\.max_anchors -->"):
        table("", recorded(), grown(45000))
    text = table(" former initial.growth.max_anchors", grown(45000))
    assert "**Of a former program** (commit abc1234)" in text
    assert "`initial.growth.max_anchors` 45000, now 120000;" in text
    assert refresh_text(text, {"ring": [grown(45000)]}) == text


def test_fields_of_one_program_only_are_refused_and_counted() -> None:
    old = recorded(normalised_radius=1.0)
    with pytest.raises(ConfigError, match="ring former -->"):
        table("", old)
    assert "1 fields of its configuration are gone, 0 are new." in table(" former", old)


@pytest.mark.parametrize(
    "marker", [" former", " former initial.growth.stop", " former initial.growth.max_anchors seed"]
)
def test_a_marker_accepts_exactly_what_differs(marker: str) -> None:
    with pytest.raises(ConfigError, match=r"initial\.growth\.max_anchors differs from today's"):
        table(marker, grown(45000))


def test_a_marker_of_a_former_program_is_refused_once_its_rows_have_been_run_again() -> None:
    with pytest.raises(ConfigError, match="no field that both have differs"):
        table(" former", recorded())


def test_rows_that_a_table_does_not_show_may_be_of_any_program() -> None:
    assert "former" not in table("", recorded(), replace(grown(1), identity={**grown(1).identity, "key": "held"}))
