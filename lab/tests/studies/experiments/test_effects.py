# SPDX-License-Identifier: Apache-2.0
"""The table of effects: each row throws the switches that it names and no others, and is compared with the whole."""

from dataclasses import replace

import pytest

from outcomes import outcome, outcomes
from structgstream.errors import ConfigError
from structgstream.session.presets import COMPACT, PRESETS, RIG, to_json
from structgstream_studies.experiments.effects import (
    BETTER_FIRST,
    CARRIED_SHARE,
    EASED,
    WHOLE,
    effects,
    effects_sheet,
)
from structgstream_studies.experiments.studies import COMPACT_PRESET, effect_titles, method_key, variant_titles
from structgstream_studies.experiments.variants import FULL
from test_variants import differing

ROWS = effects(COMPACT, paper=RIG)


@pytest.mark.parametrize("key", sorted(ROWS.keys() - {FULL, BETTER_FIRST}))
def test_a_row_differs_from_the_whole_in_the_fields_it_names_and_no_others(key: str) -> None:
    row = ROWS[key]
    assert differing(to_json(COMPACT), to_json(row.config)) <= row.changes
    assert (to_json(COMPACT) != to_json(row.config)) == bool(row.changes) == (key != WHOLE)
    assert len(row.changes) <= 3 or key == "compact-without-disturbance"


def test_what_the_switches_are() -> None:
    online = {key: row.config.online for key, row in ROWS.items()}
    whole = online[WHOLE]
    assert ROWS[WHOLE].config == COMPACT
    assert ROWS[FULL].config == RIG
    assert ROWS[BETTER_FIRST].config == replace(RIG, initial=COMPACT.initial, denoising=COMPACT.denoising)
    calm = ROWS["compact-without-disturbance"].config
    assert calm.initial == replace(COMPACT.initial, perturbation=RIG.initial.perturbation)
    plain = ROWS["compact-paper-losses"].config.initial.losses
    assert (plain.l1, plain.ssim) == (RIG.initial.losses.l1, RIG.initial.losses.ssim) == (1.0, 0.2)
    many = ROWS["compact-offsets"].config.initial
    assert (many.offsets_per_anchor, many.all_drawn) == (RIG.initial.offsets_per_anchor, False)
    assert COMPACT.initial.all_drawn
    assert not online["compact-without-gate"].motion.enabled
    assert "covariance_mlp" not in online["compact-without-gate"].dynamic
    assert online["compact-without-rate"].rounding.rate_weight == 0.0
    assert whole.dynamic - online["compact-without-appearance"].dynamic == {"appearance"}
    assert whole.dynamic - online["compact-without-base-scales"].dynamic == {"base_scales"}
    barren = online["compact-without-free"]
    assert barren.patching.spawn == "off"
    assert not barren.spawn.enabled
    assert whole.spawn.enabled
    assert (whole.patching.spawn, online["compact-gradient-births"].patching.spawn) == ("off", "gradient")
    assert whole.scene_flow.enabled
    assert not online["compact-without-start"].scene_flow.enabled
    assert (whole.scene_flow.rounds, online["compact-one-round"].scene_flow.rounds) == (2, 1)
    assert online["compact-without-residuals"].motion.residual_threshold == 0.0 < whole.motion.residual_threshold
    assert whole.rounding.free_priced
    assert not online["compact-free-unpriced"].rounding.free_priced
    paced = online["compact-more-iterations"]  # The key is from when the whole had fewer, not more.
    assert (
        (paced.iterations, paced.patching.iteration)
        == (100, 50)
        == (RIG.online.iterations, RIG.online.patching.iteration)
    )
    assert whole.iterations > paced.iterations
    assert online["compact-rank-8"].appearance_rank == 8 != whole.appearance_rank
    dark = online["compact-without-light"]
    assert whole.exposure.enabled
    assert not dark.exposure.enabled
    assert whole.dynamic - dark.dynamic == {"color_mlp"}
    assert online["compact-without-coherence"].smoothness.weight == 0.0 < whole.smoothness.weight
    assert whole.spawn.thin.enabled
    assert not online["compact-without-thin-births"].spawn.thin.enabled


def test_what_is_off_is_tried_and_what_is_on_is_left_out() -> None:
    online = COMPACT.online
    given = {"hysteresis": 0.3, "occluded_share": 0.7}
    none = {"hysteresis": 1.0, "occluded_share": 0.0}
    on = replace(online, motion=replace(online.motion, **given))
    off = replace(online, motion=replace(online.motion, **none))
    tried = (off, EASED, CARRIED_SHARE)
    for whole, ease, carried in ((on, 1.0, 0.0), tried):
        rows = effects(replace(COMPACT, online=whole), paper=RIG)
        assert rows["compact-memory"].config.online.motion.hysteresis == ease
        assert rows["compact-carrying"].config.online.motion.occluded_share == carried


@pytest.mark.parametrize(("whole", "other"), [(0.0, 1.0), (0.7, 0.0)])
def test_a_prior_is_left_out_where_there_is_one_and_tried_where_there_is_none(whole: float, other: float) -> None:
    full = replace(COMPACT, online=replace(COMPACT.online, motion_prior=whole))
    row = effects(full, paper=RIG)["compact-motion-prior"]
    assert row.config.online.motion_prior == other
    assert row.title.startswith("w/o") == (other == 0.0)


def test_no_two_rows_are_the_same_and_no_key_or_title_is_of_another_table() -> None:
    assert len({str(to_json(row.config)) for row in ROWS.values()}) == len(ROWS)
    titles = effect_titles()
    assert len(set(titles.values())) == len(titles) == len(ROWS)
    assert titles.keys() & variant_titles().keys() == {FULL}
    assert method_key(COMPACT_PRESET) == WHOLE in PRESETS


def test_a_stream_that_is_not_compact_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"need codec 'compact', got 'raw'; take --preset compact"):
        effects(replace(COMPACT, codec="raw"), paper=RIG)


def test_rows_beside_the_whole_seed_by_seed() -> None:
    mean = {"online_bytes": 12_345.0, "psnr_changed": 26.5, "flicker": 0.4321}
    found = [outcome(WHOLE, seed, psnr=psnr, mean=mean) for seed, psnr in enumerate((30.0, 31.0, 32.0))]
    found += outcomes("compact-without-gate", (30.1, 31.2, 32.3))
    found += [outcome(FULL, psnr=29.5, mean={"online_bytes": 1.73e6}), outcome("held", psnr=5.0)]
    sheet = effects_sheet(found, titles=effect_titles())
    rows = {row[0]: dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows}
    assert list(rows) == list(effect_titles().values())
    whole, gate, paper = (rows[effect_titles()[key]] for key in (WHOLE, "compact-without-gate", FULL))
    assert whole["KB a frame"] == "12.3 ± 0.0"
    assert (whole["seeds"], whole["PSNR, dB"], whole["to compact, dB"]) == ("3", "31.00 ± 1.00", "-")
    assert (whole["changed, dB"], whole["flicker, 1/255"]) == ("26.50 ± 0.00", "0.432 ± 0.000")
    assert gate["to compact, dB"] == "+0.20 ± 0.10"
    assert (paper["seeds"], paper["to compact, dB"], paper["KB a frame"]) == ("1", "-0.50", "1730.0")
    assert set(rows["w/o appearance"].values()) == {"w/o appearance", "-"}


def test_without_the_whole_nothing_is_compared() -> None:
    sheet = effects_sheet([outcome(FULL)], titles=effect_titles())
    assert {row[4] for row in sheet.rows} == {"-"}
    assert all(len(row) == len(sheet.columns) for row in sheet.rows)
