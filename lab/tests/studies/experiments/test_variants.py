# SPDX-License-Identifier: Apache-2.0
"""Each ablation is an edit of exactly the fields that it names."""

import pytest

from structgstream.session.presets import MOTION, PAPER, RIG, StreamConfig, to_json
from structgstream_studies.experiments.variants import FULL, TABLES, variants


def differing(old: object, new: object, path: str = "") -> set[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        keys = old.keys() | new.keys()  # a field may be left out while it has its default
        return set().union(*(differing(old.get(key), new.get(key), f"{path}.{key}" if path else key) for key in keys))
    return {path} if old != new else set()


@pytest.mark.parametrize("full", [PAPER, RIG, MOTION], ids=["paper", "rig", "motion"])
def test_a_variant_differs_from_the_full_method_in_the_fields_it_names_and_no_others(full: StreamConfig) -> None:
    for variant in variants(full).values():
        assert differing(to_json(full), to_json(variant.config)) == variant.changes, variant.key
        assert bool(variant.changes) == (variant.key != FULL), variant.key


def test_every_row_of_every_table_is_a_variant_and_every_variant_but_the_floor_is_in_a_table() -> None:
    known = variants(RIG)
    rows = [key for table in TABLES.values() for key in table.rows]
    assert set(rows) == known.keys() - {"held"}
    assert all(FULL in table.rows for table in TABLES.values())


def test_the_papers_thresholds() -> None:
    known = variants(PAPER)
    taus = [
        known[key].config.online.patching.grad_threshold for key in ("independent-1", "independent-2", "independent-3")
    ]
    assert taus == [1e-3, 1.5e-4, 1e-4]


def test_no_two_variants_are_the_same() -> None:
    configs = [str(to_json(variant.config)) for variant in variants(RIG).values()]
    assert len(set(configs)) == len(configs)
