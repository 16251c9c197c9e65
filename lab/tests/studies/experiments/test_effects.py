# SPDX-License-Identifier: Apache-2.0
"""The table of effects: each row leaves out what it names and nothing else, and is compared with the whole."""

import operator
from dataclasses import replace

import pytest

from outcomes import outcome, outcomes
from structgstream.errors import ConfigError
from structgstream.session.presets import COMPACT, PRESETS, RIG, to_json
from structgstream_studies.experiments.effects import BARE, PAPER_ONLINE, WHOLE, effects, effects_sheet
from structgstream_studies.experiments.studies import COMPACT_PRESET, effect_titles, method_key, rows_of, variant_titles
from structgstream_studies.experiments.variants import FULL
from test_variants import differing

ROWS = effects(COMPACT, paper=RIG)


LEFT_OUT = {
    "compact-all-dynamic": ("motion.enabled", False),
    "compact-without-hysteresis": ("motion.hysteresis", 1.0),
    "compact-without-residuals": ("motion.residual_threshold", 0.0),
    "compact-occluded-static": ("motion.occluded_share", 0.0),
    "compact-without-rate-term": ("rounding.rate_weight", 0.0),
    "compact-without-free-rate-term": ("rounding.free_priced", False),
    "compact-without-smoothness": ("smoothness.weight", 0.0),
    "compact-without-motion-prior": ("motion_prior", 0.0),
    "compact-without-scene-flow": ("scene_flow.enabled", False),
    "compact-one-round": ("scene_flow.rounds", 1),
    "compact-without-spawn": ("spawn.enabled", False),
    "compact-without-thin-spawn": ("spawn.thin.enabled", False),
}
"""Rows of online frames that change one field, and the value that leaves it out."""


@pytest.mark.parametrize("key", sorted(ROWS.keys() - {FULL, PAPER_ONLINE}))
def test_a_row_differs_from_the_whole_in_the_fields_it_names_and_no_others(key: str) -> None:
    row = ROWS[key]
    assert differing(to_json(COMPACT), to_json(row.config)) == row.changes
    assert bool(row.changes) == (key != WHOLE)


@pytest.mark.parametrize("key", sorted(LEFT_OUT))
def test_a_row_leaves_out_what_its_name_says(key: str) -> None:
    path, value = LEFT_OUT[key]
    assert ROWS[key].changes == {f"online.{path}"}
    assert operator.attrgetter(path)(ROWS[key].config.online) == value


def test_rows_of_several_fields() -> None:
    whole = COMPACT.online.dynamic
    assert ROWS[WHOLE].config == COMPACT
    assert ROWS[FULL].config == RIG
    assert ROWS[PAPER_ONLINE].config == replace(RIG, initial=COMPACT.initial, denoising=COMPACT.denoising)
    calm = ROWS["compact-without-perturbation"].config
    assert calm.initial == replace(COMPACT.initial, perturbation=RIG.initial.perturbation)
    plain = ROWS["compact-paper-losses"].config.initial.losses
    assert (plain.l1, plain.ssim) == (RIG.initial.losses.l1, RIG.initial.losses.ssim) == (1.0, 0.2)
    many = ROWS["compact-paper-offsets"].config.initial
    assert (many.offsets_per_anchor, many.all_drawn) == (RIG.initial.offsets_per_anchor, False) == (5, False)
    assert ROWS["compact-single-picture"].config.denoising.frames == 1
    assert not ROWS["compact-with-floaters"].config.initial.floaters.enabled
    assert whole - ROWS["compact-without-appearance"].config.online.dynamic == {"appearance"}
    assert whole - ROWS["compact-without-base-scales"].config.online.dynamic == {"base_scales"}
    dark = ROWS["compact-without-light"].config.online
    assert not dark.exposure.enabled
    assert whole - dark.dynamic == {"color_mlp"}


def test_the_bare_row_lacks_all_parts_about_motion() -> None:
    parts = ("scene-flow", "spawn", "residuals", "smoothness", "motion-prior")
    keys = [f"compact-without-{part}" for part in parts] + ["compact-occluded-static"]
    assert ROWS[BARE].changes == {change for key in keys for change in ROWS[key].changes}


@pytest.mark.parametrize("preset", ["compact", "fast", "tiny"])
def test_every_compact_preset_has_all_parts(preset: str) -> None:
    assert effects(PRESETS[preset], paper=RIG).keys() == ROWS.keys()


@pytest.mark.parametrize("key", sorted(LEFT_OUT))
def test_a_part_that_is_off_already_cannot_be_left_out(key: str) -> None:
    with pytest.raises(ConfigError, match=r"leaves out .*, which is off already"):
        effects(ROWS[key].config, paper=RIG)


def test_no_two_rows_are_the_same_and_no_key_or_title_is_of_another_table() -> None:
    assert len({str(to_json(row.config)) for row in ROWS.values()}) == len(ROWS)
    titles = effect_titles()
    assert len(set(titles.values())) == len(titles) == len(ROWS)
    assert titles.keys() & variant_titles().keys() == {FULL}
    assert list(titles) == rows_of("effects")
    assert method_key(COMPACT_PRESET) == WHOLE in PRESETS


def test_a_stream_that_is_not_compact_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"need codec 'compact', got 'raw'; take --preset compact"):
        effects(replace(COMPACT, codec="raw"), paper=RIG)


def test_rows_beside_the_whole_seed_by_seed() -> None:
    mean = {"online_bytes": 12_345.0, "psnr_changed": 26.5, "flicker": 0.4321}
    found = [outcome(WHOLE, seed, psnr=psnr, mean=mean) for seed, psnr in enumerate((30.0, 31.0, 32.0))]
    found += outcomes("compact-all-dynamic", (30.1, 31.2, 32.3))
    found += [outcome(FULL, psnr=29.5, mean={"online_bytes": 1.73e6}), outcome("held", psnr=5.0)]
    sheet = effects_sheet(found, titles=effect_titles())
    rows = {row[0]: dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows}
    assert list(rows) == [effect_titles()[key] for key in (WHOLE, FULL, "compact-all-dynamic")]
    whole, gate, paper = (rows[effect_titles()[key]] for key in (WHOLE, "compact-all-dynamic", FULL))
    assert whole["KB a frame"] == "12.3 ± 0.0"
    assert (whole["seeds"], whole["PSNR, dB"], whole["to compact, dB"]) == ("3", "31.00 ± 1.00", "-")
    assert (whole["changed, dB"], whole["flicker, 1/255"]) == ("26.50 ± 0.00", "0.432 ± 0.000")
    assert gate["to compact, dB"] == "+0.20 ± 0.10"
    assert (paper["seeds"], paper["to compact, dB"], paper["KB a frame"]) == ("1", "-0.50", "1730.0")


def test_without_the_whole_nothing_is_compared() -> None:
    sheet = effects_sheet([outcome(FULL)], titles=effect_titles())
    assert {row[4] for row in sheet.rows} == {"-"}
    assert all(len(row) == len(sheet.columns) for row in sheet.rows)
