# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from benchmarks.contest import Contestant, Quantity, check, ratios, timed
from benchmarks.growth import slope


def constant(name: str, *values: float | None) -> Contestant:
    return Contestant(name, lambda: [None if value is None else torch.full((5,), value) for value in values], 1)


@pytest.mark.parametrize("measure", ["median", "norm", "largest"])
def test_a_wrong_contestant_is_not_timed(measure) -> None:
    quantities = [Quantity("answer", 1e-4, measure)]
    right, wrong = constant("right", 1.0), constant("wrong", 1.1)
    assert check([right, right], quantities) == {"right": {"answer": 0.0}}
    with pytest.raises(SystemExit, match="wrong differs from right in answer"):
        check([right, wrong], quantities)


def test_not_a_number_and_another_shape_are_wrong() -> None:
    quantities = [Quantity("answer", 1e9)]
    with pytest.raises(SystemExit):
        check([constant("right", 1.0), constant("broken", float("nan"))], quantities)
    with pytest.raises(SystemExit):
        check([constant("right", 1.0), Contestant("short", lambda: [torch.ones(4)], 1)], quantities)
    with pytest.raises(ValueError, match="argument"):
        check([constant("right", 1.0), constant("more", 1.0, 2.0)], quantities)


def test_what_a_contestant_does_not_compute_is_not_compared() -> None:
    quantities = [Quantity("value", 1e-4), Quantity("gradient", 1e-4)]
    assert check([constant("both", 1.0, 2.0), constant("value only", 1.0, None)], quantities) == {
        "value only": {"value": 0.0}
    }


def test_every_round_starts_with_another_contestant_and_threads_are_set() -> None:
    seen: list[tuple[str, int]] = []

    def entry(name: str, threads: int) -> Contestant:
        return Contestant(name, lambda: seen.append((name, torch.get_num_threads())) or [], threads)

    seconds = timed([entry("a", 1), entry("b", 2)], repeats=2, turn_seconds=0.0)
    assert seen == [("a", 1), ("b", 2), ("b", 2), ("a", 1)]
    assert {name: len(values) for name, values in seconds.items()} == {"a": 2, "b": 2}


def test_seconds_are_for_one_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 6.0])
    monkeypatch.setattr("benchmarks.contest.time.perf_counter", lambda: next(clock))
    assert timed([Contestant("three at once", list, 1, units=3)], repeats=1) == {"three at once": [2.0]}


def test_ratios_are_taken_within_each_round() -> None:
    # The machine was half as fast in the second round: the ratio is not.
    assert ratios({"slow": [8.0, 16.0], "fast": [2.0, 4.0]}) == {"fast": {"median": 4.0, "least": 4.0, "most": 4.0}}


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_slope_of_a_power_law(power: float) -> None:
    sizes = [100.0, 200.0, 400.0, 800.0]
    assert slope(sizes, [3e-6 * size**power for size in sizes]) == pytest.approx(power, abs=1e-9)
