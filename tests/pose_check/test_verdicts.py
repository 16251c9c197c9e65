# SPDX-License-Identifier: Apache-2.0
"""Which cameras are off, from matches of made rigs."""

from collections.abc import Callable

import pytest

from structgstream.pose_check.verdicts import MIN_MATCHES, Verdict, judge
from tests.support.evidence_made import Cameras, evidence_of, scattered, shifted, turned, wide_ring

RIG = wide_ring(7)


def judged(change: Callable[[Cameras], object] | None = None, *, points: int = 200) -> Verdict:
    """The verdict on cameras of which some were changed after they had filmed."""
    evidence = evidence_of(RIG, scattered(points), noise=0.3)
    cameras = dict(RIG)
    if change is not None:
        change(cameras)
    return judge(evidence, cameras)


def test_a_rig_that_is_right() -> None:
    found = judged()
    assert (found.suspects.off, found.doubtful, found.unchecked) == ((), (), ())
    assert not found.resections
    assert not found.suspects.everything


@pytest.mark.parametrize("name", ["cam0", "cam3", "cam6"])
def test_a_camera_that_turned_is_named_with_its_correction(name: str) -> None:
    found = judged(lambda cameras: cameras.update({name: turned(cameras[name], 1.0)}))
    assert found.suspects.off == (name,)
    assert set(found.resections) == {name}
    correction = found.resections[name]
    assert correction.better
    assert correction.given_pixels > found.suspects.limit_pixels


def test_two_cameras_that_moved() -> None:
    def change(cameras: Cameras) -> None:
        cameras["cam1"] = shifted(cameras["cam1"], (0.0, 0.1, 0.0))
        cameras["cam5"] = turned(cameras["cam5"], 2.0, axis=0)

    found = judged(change)
    assert set(found.suspects.off) == {"cam1", "cam5"} == set(found.resections)


def test_a_camera_that_moved_along_what_pairs_cannot_see_is_accused_by_points() -> None:
    """Moved away from everything, towards which epipolar lines run: pairs look well, points do not."""

    def change(cameras: Cameras) -> None:
        direction = cameras["cam3"].center / cameras["cam3"].center.norm()
        cameras["cam3"] = shifted(cameras["cam3"], tuple((0.15 * direction).tolist()))

    found = judged(change)
    assert found.suspects.off == ("cam3",)
    assert "cam3" in found.resections


def test_all_cameras_written_the_wrong_way_round_are_one_mistake() -> None:
    def change(cameras: Cameras) -> None:
        for name, camera in cameras.items():
            cameras[name] = type(camera)(camera.viewmat.inverse(), camera.K, camera.width, camera.height)

    found = judged(change)
    assert found.suspects.everything
    assert not found.resections


def test_few_matches_accuse_nobody() -> None:
    """Fewer than chance may make: the camera is named as one that could not be checked, if at all."""
    found = judged(lambda cameras: cameras.update(cam3=turned(cameras["cam3"], 3.0)), points=5)
    assert found.suspects.off in ((), ("cam3",))
    if not found.suspects.off:
        assert found.unchecked in ((), ("cam3",))
    assert 5 * len(RIG) < MIN_MATCHES
