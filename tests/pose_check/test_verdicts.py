# SPDX-License-Identifier: Apache-2.0
"""Which cameras are off, from matches of made rigs."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from structgstream.pose_check import verdicts
from structgstream.pose_check.verdicts import MIN_MATCHES, Resection, Verdict, judge
from tests.support.evidence_made import Cameras, evidence_of, scattered, shifted, turned, wide_ring

RIG = wide_ring(7)


def judged(change: Callable[[Cameras], object] | None = None, *, points: int = 200) -> Verdict:
    """The verdict on cameras of which some were changed after they had filmed."""
    evidence = evidence_of(RIG, scattered(points), noise=0.3)
    cameras = dict(RIG)
    if change is not None:
        change(cameras)
    return judge(evidence, cameras)


def farther(cameras: Cameras) -> None:
    """Moves a camera away from everything, towards which epipolar lines run."""
    direction = cameras["cam3"].center / cameras["cam3"].center.norm()
    cameras["cam3"] = shifted(cameras["cam3"], tuple((0.15 * direction).tolist()))


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
    """Pairs look well, points do not."""
    found = judged(farther)
    assert found.suspects.off == ("cam3",)
    assert "cam3" in found.resections


def test_a_camera_that_no_correction_explains_better_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points of the others lie far from where it sees them: wrong matches do that, too."""
    found = Resection(
        points=20, given_points=25, seen=60, given_pixels=50.0, corrected_pixels=40.0, degrees=1.0, degrees_error=0.1,
        share_of_distance=0.0, share_error=0.1, focal_percent=0.0, focal_error=0.1,
    )  # fmt: skip
    monkeypatch.setattr(verdicts, "resect", lambda *arguments: found)
    assert judged(farther).suspects.off == ()
    monkeypatch.setattr(verdicts, "resect", lambda *arguments: replace(found, points=30, corrected_pixels=1.0))
    assert judged(farther).suspects.off == ("cam3",)


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
