# SPDX-License-Identifier: Apache-2.0
"""Pictures in, sets out, in synthetic time."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.live.status import Fault
from structgstream.data.live.synchronizer import FrameSynchronizer, LivePicture, PictureSet
from tests.support.properties import examples

PERIOD = 1 / 30


class Rig:
    """A matcher, what it counted, and a way to feed it."""

    def __init__(self, names: str, *, fps: float = 30.0, tolerance: float = PERIOD / 2, deadline: float = 0.5, most=32):
        self.counted: Counter[tuple[str, Fault]] = Counter()
        self.synchronizer = FrameSynchronizer(
            names,
            fps=fps,
            tolerance_seconds=tolerance,
            deadline_seconds=deadline,
            queue_frames=most,
            count=lambda camera, fault: self.counted.update([(camera, fault)]),
        )

    def send(self, cameras: str, seconds: float, arrived: float | None = None) -> None:
        """A picture of each camera; their names have one letter."""
        for name in cameras:
            self.synchronizer.add(name, LivePicture(seconds, seconds if arrived is None else arrived, (name, seconds)))

    def sets(self, now: float) -> list[PictureSet]:
        return [*iter(lambda: self.synchronizer.next_set(now), None)]

    def played(self, *events: tuple[float, str]) -> list[PictureSet]:
        """The sets of pictures that come in the order of their times."""
        found = []
        for seconds, camera in sorted(events):
            self.send(camera, seconds)
            found += self.sets(seconds)
        return found


def contents(found: list[PictureSet]) -> list[dict[str, float]]:
    return [{name: picture.seconds for name, picture in one.pictures.items()} for one in found]


def test_a_set_is_ready_when_every_present_camera_has_sent() -> None:
    rig = Rig("abc")
    rig.send("ca", 1.0)
    assert contents(rig.sets(1.01)) == [{"a": 1.0, "c": 1.0}]  # b never sent: nobody waits for it
    rig.send("ba", 1.0 + PERIOD)
    assert rig.sets(1.04) == []
    rig.send("c", 1.0 + PERIOD)
    assert contents(rig.sets(1.04)) == [dict.fromkeys("abc", 1.0 + PERIOD)]


def test_a_camera_that_falls_silent_is_waited_for_until_the_deadline_and_no_longer() -> None:
    rig = Rig("ab", deadline=0.5)
    rig.send("ab", 0.0)
    assert len(rig.sets(0.0)) == 1
    rig.send("a", 0.1)
    assert rig.sets(0.3) == []
    assert contents(rig.sets(0.61)) == [{"a": 0.1}]
    rig.send("a", 0.7)
    assert contents(rig.sets(0.7)) == [{"a": 0.7}]  # b is gone now
    rig.send("ba", 0.8)
    assert contents(rig.sets(0.8)) == [{"a": 0.8, "b": 0.8}]  # and is back


def test_a_camera_known_to_be_gone_is_not_waited_for() -> None:
    rig = Rig("ab")
    rig.send("ab", 0.0)
    rig.sets(0.0)
    rig.synchronizer.mark_absent("b")
    rig.send("a", 0.1)
    assert contents(rig.sets(0.1)) == [{"a": 0.1}]


def test_when_the_leader_goes_another_camera_leads() -> None:
    rig = Rig("abc")
    rig.send("abc", 0.0)
    rig.sets(0.0)
    found = []
    for number in range(1, 40):
        rig.send("bc", number * PERIOD)
        found.append(rig.sets(number * PERIOD))
    assert not any(found[:14])  # until the deadline a may still come
    assert [len(one.pictures) for sets in found for one in sets] == [2] * 39


@pytest.mark.parametrize("fps", [0.5, 1.0])
def test_slow_cameras_are_present_between_their_pictures(fps: float) -> None:
    """Their latencies differ by more than a tick, and by less than the deadline."""
    rig = Rig("ab", fps=fps, tolerance=0.5 / fps)
    found = []
    for second in range(20):
        rig.send("a", second / fps, arrived=second / fps + 0.05)
        found += rig.sets(second / fps + 0.3)
        rig.send("b", second / fps, arrived=second / fps + 0.4)
        found += rig.sets(second / fps + 0.4)
    assert [len(one.pictures) for one in found[1:]] == [2] * (len(found) - 1)
    assert len(found) >= 19


def test_a_camera_whose_clock_is_ahead_and_that_leads_once_does_not_stop_the_others() -> None:
    rig, found = Rig("abc"), []
    for number in range(120):
        now = number * PERIOD
        for camera in "abc" if number >= 30 else "c":
            rig.send(camera, now + 3600.0 * (camera == "c"), arrived=now)
        found += rig.sets(now)
    assert [[*one.pictures] for one in found] == [["c"]] * 30 + [["a", "b"]] * 90
    times = [one.seconds for one in found[30:]]
    assert times == sorted(times)


def test_late_pictures_of_a_camera_that_begins_to_lead_are_no_set() -> None:
    rig = Rig("ab", deadline=0.2)
    for number in range(60):
        rig.send("a", number * PERIOD)
        rig.sets(number * PERIOD)
    rig.synchronizer.mark_absent("a")
    rig.send("b", 0.0, arrived=2.0)
    assert rig.sets(2.0) == []


@pytest.mark.parametrize("phases", [(0, 0.3, 0.9), (0, 0.49, 0.51), (0.9, 0.1, 0.5)])
def test_cameras_of_any_phase_are_in_every_set(phases: tuple[float, ...]) -> None:
    events = [((n + phase) * PERIOD, camera) for camera, phase in zip("abc", phases) for n in range(100)]
    found = Rig("abc").played(*events)
    assert len(found) >= 97
    assert all(len(one.pictures) == 3 for one in found[2:])
    assert max(abs(p.seconds - one.seconds) for one in found for p in one.pictures.values()) <= PERIOD / 2 + 1e-9


def test_rates_that_differ_by_little_lose_a_picture_now_and_then() -> None:
    found = Rig("ab").played(*((n / 30, "a") for n in range(900)), *((n / 29.97, "b") for n in range(899)))
    assert len(found) >= 897
    assert sum("b" not in one.pictures for one in found) <= 2


def test_a_leader_of_twice_the_rate_gives_every_second_picture() -> None:
    rig = Rig("ab")
    for n in range(60):
        rig.send("a", n / 60)
        if n % 2 == 0:
            rig.send("b", n / 60)
    steps = np.diff([one.seconds for one in rig.sets(10.0)])
    assert np.allclose(steps, 1 / 30)


def test_the_oldest_is_dropped_and_counted() -> None:
    rig = Rig("ab", most=4)
    for number in range(11):
        rig.send("b", number * PERIOD)
    assert rig.synchronizer.queue_lengths == {"a": 0, "b": 4}
    assert rig.counted["b", Fault.OVERFLOW] == 7


def test_a_late_picture_belongs_to_no_set_and_is_counted() -> None:
    rig = Rig("ab", deadline=0.2)
    rig.send("ab", 0.0)
    rig.sets(0.0)
    rig.send("a", 0.1)
    assert len(rig.sets(0.31)) == 1
    rig.send("b", 0.1, arrived=0.32)
    rig.send("ab", 0.4)
    assert contents(rig.sets(0.41)) == [{"a": 0.4, "b": 0.4}]
    assert rig.counted["b", Fault.UNMATCHED] == 1


@pytest.mark.parametrize("off", [-0.8, 2.0])
def test_a_camera_out_of_step_is_named_with_its_distance(off: float) -> None:
    rig = Rig("ab")
    for number in range(120):
        rig.send("a", number * PERIOD)
        rig.send("b", number * PERIOD + off, arrived=number * PERIOD)
        rig.sets(number * PERIOD)
    astray = rig.synchronizer.out_of_step(30)
    assert [*astray] == ["b"]
    assert astray["b"] * off > 0
    assert abs(astray["b"]) > PERIOD / 2


@given(st.lists(st.tuples(st.sampled_from("abc"), st.floats(0.001, 0.2)), max_size=120), st.floats(0.01, 0.3))
@examples(150)
def test_no_picture_is_used_twice_and_times_rise(events: list[tuple[str, float]], deadline: float) -> None:
    rig, now = Rig("abc", deadline=deadline), 0.0
    times, used = [], []
    for camera, wait in events:
        now += wait
        rig.send(camera, now)
        for one in rig.sets(now):
            times.append(one.seconds)
            used += [picture.content for picture in one.pictures.values()]
            assert all(abs(picture.seconds - one.seconds) <= PERIOD / 2 for picture in one.pictures.values())
    assert len(set(used)) == len(used)
    assert all(b - a >= 0.75 * PERIOD - 1e-9 for a, b in pairwise(times))
    lost = sum(count for count in rig.counted.values())
    assert len(used) + lost + sum(rig.synchronizer.queue_lengths.values()) == len(events)
