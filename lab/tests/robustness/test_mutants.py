# SPDX-License-Identifier: Apache-2.0
"""The list of mistakes is of the present sources and tests."""

import tomllib

import pytest

from lab.robustness.mutants.__main__ import MUTANTS, ROOT


@pytest.mark.parametrize("name", (found := tomllib.loads(MUTANTS.read_text())))
def test_the_place_of_a_mistake_is_there_once_and_so_are_the_tests_that_find_it(name: str) -> None:
    mutant = found[name]
    assert (ROOT / "src" / "structgstream" / mutant["file"]).read_text().count(mutant["before"]) == 1
    assert mutant["before"] != mutant["after"]
    assert all((ROOT / path).is_file() for path in mutant["tests"])
