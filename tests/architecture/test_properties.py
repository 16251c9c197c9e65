# SPDX-License-Identifier: Apache-2.0
"""Every property is tried as ``properties`` says, also one that names no number of examples."""

from hypothesis import settings

from tests.support.properties import THOROUGH, examples


def test_no_property_is_timed_and_ordinary_runs_draw_nothing() -> None:
    for used in (settings(), examples(8)):
        assert used.deadline is None
        assert used.derandomize != THOROUGH
    assert settings().max_examples == (100 if THOROUGH else 10)
