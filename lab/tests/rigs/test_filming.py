# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.rigs.filming import Filming, walk
from lab.rigs.rig import STEP_SECONDS, STEPS
from lab.rigs.variants import VARIANTS


@given(ticks=st.integers(1, 700), seed=st.integers(0, 1000))
def test_the_scene_stays_within_its_steps_and_never_jumps(ticks: int, seed: int) -> None:
    steps = walk(ticks, seed=seed)
    assert len(steps) == ticks
    assert steps.min() >= 0
    assert steps.max() < STEPS
    assert (np.abs(np.diff(steps)) <= 1).all()


def test_a_take_begins_with_motion_and_has_rests_and_turns() -> None:
    steps = walk(800, seed=3)
    assert (np.diff(steps[:8:2]) > 0).all()
    assert {0, STEPS - 1} <= set(steps.tolist())
    moves = np.diff(steps)
    assert 0.1 < (moves == 0).mean() < 0.7
    # It never turns within a frame, which cameras half a frame apart would see differently.
    turns = [step for step in moves if step]
    runs = np.flatnonzero(np.diff(turns))
    assert np.diff(runs).min() > 4


@given(begins=st.integers(0, 60), rate=st.floats(0.99, 1.01), frames=st.integers(1, 400))
def test_stamps_and_clock_give_the_instants_at_which_pictures_were_taken(begins: int, rate: float, frames: int) -> None:
    filming = Filming(begins_tick=begins, rate=rate)
    stamps = filming.stamps(frames)
    assert stamps[0] == 0
    np.testing.assert_allclose(
        filming.offset_seconds + rate * stamps, filming.ticks(frames) * STEP_SECONDS, rtol=0, atol=1e-12
    )
    assert (np.diff(stamps) > 0).all()
    # No picture is further from the even beat of its clock than half a tick.
    assert np.abs(stamps - np.arange(frames) / 30).max() <= STEP_SECONDS / 2 / rate + 1e-9


def test_a_camera_that_drops_pictures_and_dies_keeps_the_stamps_of_the_others() -> None:
    filming = Filming(dropped=(1, 3), dies_after=5)
    assert filming.kept(9).tolist() == [0, 2, 4]
    assert filming.stamps(9)[filming.kept(9)] == pytest.approx([0, 2 / 30, 4 / 30])


@pytest.mark.parametrize("name", VARIANTS)
def test_what_befalls_a_camera_befalls_it_within_its_take(name: str) -> None:
    variant = VARIANTS[name]
    for filming in variant.cameras.values():
        assert filming.bumped_from is None or 0 < filming.bumped_from < variant.frames
        assert filming.dies_after is None or filming.dies_after < variant.frames
        assert all(0 < number < variant.frames - 1 for number in filming.dropped)
