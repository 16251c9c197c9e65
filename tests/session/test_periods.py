# SPDX-License-Identifier: Apache-2.0
"""When another period begins, from times and residuals alone."""

import pytest

from structgstream.codec.packets import PacketKind
from structgstream.errors import ConfigError
from structgstream.session import periods
from structgstream.session.periods import KeyFrames, PeriodConfig, PeriodPlan

FPS, KEY_EVERY = 25.0, 5


def begun(
    config: PeriodConfig,
    residuals: list[float],
    *,
    start: int = 0,
    times: list[float] | None = None,
) -> list[int]:
    """The frames that begin periods; a run that is resumed at ``start`` measures again what its plan asks for."""
    plan, keys, found = PeriodPlan(config), KeyFrames(KEY_EVERY, FPS), [0]
    plan.begin(0, 0.0)
    seconds = [index / FPS for index in range(len(residuals))] if times is None else times
    for index, residual in enumerate(residuals):
        if index == start > 0:
            plan = PeriodPlan(config)
            plan.begin(found[-1], seconds[found[-1]], number=len(found) - 1)
            for again in plan.needed(seconds[:index], keys):
                plan.add(again, residuals[again])
        if keys.kind(index, seconds[index]) is PacketKind.KEY:
            if index and plan.due(index, seconds[index]) is not None:
                plan.begin(index, seconds[index])
                found.append(index)
            keys.begin(index, seconds[index])
        if plan.measures(index, seconds[index], keys):
            plan.add(index, residual)
    return found


def test_without_a_word_there_is_one_period() -> None:
    assert not PeriodConfig().enabled
    assert begun(PeriodConfig(), [1.0] * 5 + [9.0] * 20) == [0]


def test_by_time_it_is_the_first_key_frame_after_it() -> None:
    assert begun(PeriodConfig(seconds=10 / FPS), [1.0] * 26) == [0, 10, 20]
    assert begun(PeriodConfig(seconds=11 / FPS), [1.0] * 31) == [0, 15, 30]


def test_by_residual_all_of_the_last_frames_must_be_worse() -> None:
    config = PeriodConfig(residual=1.5, frames=3)
    worse = [1.0] * 7 + [1.6] * 13
    assert begun(config, worse) == [0, 10]
    assert begun(config, [*worse[:8], 1.4, *worse[9:]]) == [0, 15]
    assert begun(config, [1.0] * 7 + [1.49] * 13) == [0]
    assert begun(config, [1.0] * 8 + [1.6] * 12) == [0, 15]


def test_what_is_measured_against_is_the_first_frame_of_the_period() -> None:
    assert begun(PeriodConfig(residual=1.5, frames=2), [1.0] * 3 + [2.0] * 7 + [3.1] * 10) == [0, 5, 15]


def test_more_frames_than_a_group_are_waited_for() -> None:
    config = PeriodConfig(residual=1.5, frames=7)
    assert begun(config, [1.0] * 4 + [2.0] * 20) == [0, 15]
    assert begun(config, [1.0] + [2.0] * 20) == [0, 10]


@pytest.mark.parametrize(
    "config",
    [
        PeriodConfig(seconds=0.5, residual=1.5, frames=2),
        PeriodConfig(residual=1.3, frames=7),
        PeriodConfig(seconds=0.4),
    ],
)
def test_a_resumed_run_decides_the_same(config: PeriodConfig) -> None:
    residuals = [1.0 + 0.13 * (index % 9) + 0.05 * index for index in range(40)]
    whole = begun(config, residuals)
    assert len(whole) > 1
    for start in range(1, 40):
        assert begun(config, residuals, start=start) == whole, start
    apart = [0.04, 0.04, 0.3, 0.05, 1.0, 0.04, 0.04]
    times = [sum(apart[i % 7] for i in range(index)) for index in range(40)]
    whole = begun(config, residuals, times=times)
    assert len(whole) > 1
    for start in range(1, 40):
        assert begun(config, residuals, start=start, times=times) == whole, start


def test_only_what_is_needed_is_measured() -> None:
    plan, keys = PeriodPlan(PeriodConfig(residual=1.5, frames=2)), KeyFrames(KEY_EVERY, FPS)
    plan.begin(0, 0.0)
    found = []
    for index in range(11):
        if keys.kind(index, index / FPS) is PacketKind.KEY:
            keys.begin(index, index / FPS)
        if plan.measures(index, index / FPS, keys):
            found.append(index)
    assert found == [0, 3, 4, 8, 9]


def test_the_last_period_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(periods, "MAX_PERIODS", 3)
    assert begun(PeriodConfig(seconds=5 / FPS), [1.0] * 40) == [0, 5, 10]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (PeriodConfig(seconds=0.0), "--period.seconds 0 is not above 0"),
        (PeriodConfig(residual=0.9), "--period.residual 0.9 is not above 1"),
        (PeriodConfig(residual=2.0, frames=0), "--period.frames 0"),
        (PeriodConfig(seconds=2.0, share=1.5), "the share above 0 and at most 1"),
    ],
)
def test_values_that_mean_nothing_are_refused(config: PeriodConfig, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PeriodPlan(config)
