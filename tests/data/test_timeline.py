# SPDX-License-Identifier: Apache-2.0
"""Which frame serves which instant: properties of the choice, and rates of made time stamps."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.timeline import (
    STEADY,
    Clock,
    common_slots,
    measured_rate,
    natural,
    origin_of,
    period_seconds,
    picture_slots,
    place,
)
from structgstream.errors import CaptureError
from tests.support.properties import examples


def common(**slots: list[int]) -> range:
    return common_slots(slots, where="take", label=lambda slot: f"frame {slot}", training=slots)


def test_numbers_sort_by_value() -> None:
    assert sorted(["cam10", "cam2", "a", "30", "4"], key=natural) == ["4", "30", "a", "cam2", "cam10"]
    numbered = ["20220101120000.2", "20220101120000.10"]
    assert sorted(numbered, key=natural) == numbered, "frames after a date"


def test_times_in_names_sort_by_value_whatever_their_number_of_decimals() -> None:
    """``str(time.time())`` leaves out the last zeros."""
    times = ["1700000000.05", "1700000000.1", "1700000000.1333", "1700000000.16", "1700000000.2"]
    assert sorted(times, key=natural) == times
    assert slots(a=" ".join(times), b=" ".join(["1700000000.10", *times[2:]])) == {
        "a": [0, 1, 2, 3, 4],
        "b": [1, 2, 3, 4],
    }


WHOLE = list(range(10))


@pytest.mark.parametrize(
    ("slots", "expected", "messages"),
    [
        (
            {"a": [0, 1, 2, 3], "b": [1, 2, 3, 4, 5]},
            range(1, 4),
            [
                "camera 'b' starts with frame 1; 1 earlier frames of other cameras are left out",
                "camera 'a' ends with frame 3; 2 later frames of other cameras are left out",
            ],
        ),
        ({"a": [4, 5], "b": [4, 5]}, range(4, 6), []),
        (
            {"a": [0, 1, 2, 3, 4], "b": [0, 1, 4], "c": [0, 1, 2, 3, 4]},
            range(5),
            ["camera 'b' lacks 2 of 5 frames, the first of them frame 2; it is absent there"],
        ),
        (
            {"a": [0, 2, 3, 4], "b": [0, 1, 4], "c": [0, 1, 3, 4], "d": [0, 1, 2, 3, 4]},
            range(5),
            ["3 cameras lack some of 5 frames and are absent there: 'a' 1, 'b' 2, 'c' 1"],
        ),
        (  # half of them still run
            {"a": WHOLE, "b": WHOLE, "c": WHOLE[:4], "d": WHOLE[:4]},
            range(10),
            [f"camera '{name}' ends with frame 3; it is absent from the 6 frames after that" for name in "cd"],
        ),
        (
            {"a": WHOLE, "b": WHOLE, "c": WHOLE[:4], "d": WHOLE[:5], "e": WHOLE[:6]},
            range(6),
            [
                "camera 'e' ends with frame 5; 4 later frames of other cameras are left out",
                "camera 'c' ends with frame 3; it is absent from the 2 frames after that",
                "camera 'd' ends with frame 4; it is absent from the 1 frames after that",
            ],
        ),
        (  # a frame that nearly nobody has
            {"a": [0, 1, 3], "b": [0, 1, 3], "c": [0, 1, 2, 3]},
            range(4),
            [
                *(
                    f"camera '{name}' lacks 1 of 4 frames, the first of them frame 2; it is absent there"
                    for name in "ab"
                ),
                "1 frames, the first of them frame 2, have pictures of fewer than 2 training cameras, so a "
                "reconstruction stops there; restore them, or choose frames before or after",
            ],
        ),
    ],
)
def test_the_range_ends_where_most_have_ended_and_what_is_left_out_is_reported(
    slots: dict[str, list[int]], expected: range, messages: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    assert common(**slots) == expected
    assert [record.getMessage() for record in caplog.records] == [f"take: {message}" for message in messages]


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ({"b": [0, 1, 1, 2, 3]}, "'b' of take has two frames for frame 1"),
        ({"b": [7, 8]}, "no frames in common: 'a' ends with frame 3 and 'b' starts with frame 7"),
        (
            {name: [7, 8, 9] for name in "bcd"},  # of another take
            "no frames in common: 'a' ends with frame 3 and 'b' starts with frame 7",
        ),
        ({"b": []}, "'b' of take has no frames"),
    ],
)
def test_a_broken_timeline_names_camera_and_instant(others: dict[str, list[int]], words: str) -> None:
    with pytest.raises(CaptureError, match=words):
        common(a=[0, 1, 2, 3], **others)


def test_two_training_cameras_reach_the_end() -> None:
    slots = {"held": [*range(10)], "a": [*range(10)], "b": [*range(4)], "c": [*range(3)]}
    label = "frame {}".format
    assert common_slots(slots, where="take", label=label, training=("a", "b", "c")) == range(4)
    assert common(**slots) == range(10)


@examples(200)
@given(st.lists(st.sets(st.integers(0, 30), min_size=1), min_size=1, max_size=6))
def test_the_range_is_the_longest_that_all_have_begun_and_half_reach(found: list[set[int]]) -> None:
    slots = {f"cam{number}": sorted(own) for number, own in enumerate(found)}
    begun = max(own[0] for own in slots.values())
    reaching = {slot: sum(own[-1] >= slot for own in slots.values()) for slot in range(31)}
    least = max(len(slots) / 2, min(2, len(slots)))
    expected = [slot for slot in range(begun, 31) if reaching[slot] >= least]
    if all(any(slot in expected for slot in own) for own in slots.values()):
        assert list(common(**slots)) == expected
    else:
        with pytest.raises(CaptureError, match="no frames in common"):
            common(**slots)


def test_a_clock_gives_common_time() -> None:
    times = Clock(offset_seconds=-2.0, rate=1.001).common_seconds(np.array([0.0, 10.0]))
    np.testing.assert_allclose(times, [-2.0, 8.01])


def slots(**names: str) -> dict[str, list[int]]:
    pictures = {camera: [Path(camera, f"{stem}.png") for stem in own.split()] for camera, own in names.items()}
    return {camera: own.tolist() for camera, own in picture_slots(pictures).items()}


def test_pictures_are_of_one_instant_by_their_names() -> None:
    """One lacks a picture, one begins late, and what no camera has is no instant."""
    assert slots(a="8 9 10 12", b="8 10 12", c="10 12 13") == {"a": [0, 1, 2, 3], "b": [0, 2, 3], "c": [2, 3, 4]}


def test_pictures_are_counted_where_a_camera_names_them_its_own_way() -> None:
    assert slots(a="8 9 10", b="8 10", c="IMG1 IMG2") == {"a": [0, 1, 2], "b": [0, 1], "c": [0, 1]}
    assert slots(a="a", b="b") == {"a": [0], "b": [0]}


def test_the_period_is_that_of_most_frames() -> None:
    assert period_seconds(np.delete(np.arange(50) / 25, [3, 4, 20])) == pytest.approx(0.04)
    assert period_seconds(np.zeros(1)) == pytest.approx(1 / 30)


TIMES = st.lists(st.floats(-3, 60), min_size=1, max_size=60).map(lambda times: np.array(sorted(times)))


@examples(400)
@given(TIMES)
def test_each_frame_serves_one_instant_and_each_instant_has_its_nearest(positions: np.ndarray) -> None:
    placed = place(positions)
    assert (np.diff(placed.slots) > 0).all()
    assert len(set(placed.frames.tolist())) == len(placed.frames)
    np.testing.assert_allclose(placed.errors, positions[placed.frames] - placed.slots)
    if abs(np.exp(2j * np.pi * positions).mean()) > STEADY:
        return  # such a camera is moved as a whole, see below
    assert (np.abs(placed.errors) <= 0.5).all()
    for slot in range(int(positions[0]) - 1, int(positions[-1]) + 2):
        within = np.abs(positions - slot)
        if slot in placed.slots:
            at = int(np.flatnonzero(placed.slots == slot)[0])
            assert abs(placed.errors[at]) == pytest.approx(within.min())
        else:
            assert within.min() >= 0.5


@examples(200)
@given(st.floats(-0.5, 0.5), st.integers(0, 2**32 - 1), st.integers(2, 80))
def test_a_steady_camera_loses_no_frame_wherever_it_lies(phase: float, seed: int, count: int) -> None:
    jitter = np.random.default_rng(seed).uniform(-0.05, 0.05, count)
    placed = place(np.arange(count) + phase + jitter)
    assert placed.frames.tolist() == list(range(count))
    assert (np.diff(placed.slots) == 1).all()
    assert np.abs(placed.errors).max() < 0.56


@examples(100)
@given(st.lists(st.floats(-0.2, 0.2), min_size=2, max_size=8), st.floats(0, 1))
def test_instants_lie_amid_the_cameras(offsets: list[float], shift: float) -> None:
    """Also when the cameras lie on both sides of half a period."""
    origin = origin_of([np.arange(4.0) + offset + shift for offset in offsets])
    apart = np.array(offsets) + shift - origin
    apart -= np.rint(apart)
    assert np.abs(np.median(apart)) < 1e-6


def test_two_frames_of_one_instant_are_reported_from_a_higher_rate() -> None:
    assert place(np.array([0.0, 1.0, 2.0, 2.25, 3.0])).repeated == (2,)
    assert place(np.arange(0, 6, 0.5)).repeated == ()


def test_the_rate_is_the_median_or_of_different_ones_the_lowest() -> None:
    thirty, sixty = np.arange(30) / 30, np.arange(60) / 60
    assert measured_rate([thirty, thirty * (1 + 1e-4), thirty]) == 30.0
    assert measured_rate([thirty, sixty, sixty]) == 30.0
    assert measured_rate([np.delete(thirty, [3, 4, 17])]) == 30.0
    assert measured_rate([np.arange(30) * 1001 / 30000]) == pytest.approx(30000 / 1001)
    assert measured_rate([np.zeros(1)]) is None
