# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.matching import pair_error, project
from structgstream.pose_check import tracks as evidence
from structgstream.pose_check.tracks import Evidence, Tracks, build_tracks, gather, pair_errors
from tests.support.evidence_made import evidence_of, scattered, turned, wide_ring
from tests.support.planes import room_frame, room_rig


def truth_of(tracks: Tracks, evidence: Evidence, name: str) -> np.ndarray:
    """Which point of the world each observation of a camera is of; keypoints are numbered as points are."""
    apart = np.linalg.norm(tracks.pixels[tracks.of(name)][:, None] - evidence.keypoints[name][None], axis=2)
    return apart.argmin(1)


def test_points_are_where_they_are() -> None:
    cameras, world = wide_ring(5), scattered(50)
    evidence = evidence_of(cameras, world)
    tracks = build_tracks(evidence, cameras)
    assert len(tracks.points) == 50
    assert tracks.views.tolist() == [5] * 50
    assert tracks.residuals.max() < 1e-5
    of_world = truth_of(tracks, evidence, "cam2")
    np.testing.assert_allclose(tracks.points[tracks.point[tracks.of("cam2")]], world[of_world], atol=1e-6)


def test_a_camera_that_is_off_moves_no_point_and_keeps_its_observations() -> None:
    cameras, world = wide_ring(5), scattered(50)
    evidence = evidence_of(cameras, world)
    stated = {**cameras, "cam1": turned(cameras["cam1"], 2.0)}
    tracks = build_tracks(evidence, stated, off=["cam1"])
    assert tracks.residuals[~tracks.of("cam1")].max() < 1e-5
    own = tracks.of("cam1")
    of_world = truth_of(tracks, evidence, "cam1")
    apart = np.linalg.norm(project(stated["cam1"], world)[0] - evidence.keypoints["cam1"], axis=1)
    np.testing.assert_allclose(tracks.residuals[own], apart[of_world], atol=1e-3)
    assert apart.min() > 20


def test_a_point_with_two_keypoints_in_one_picture_is_left_out() -> None:
    cameras = wide_ring(3)
    evidence = evidence_of(cameras, scattered(20))
    twice = np.concatenate([evidence.keypoints["cam1"], evidence.keypoints["cam1"][:1] + 0.1])
    other = evidence.matches["cam1", "cam2"].copy()
    other[0, 0] = 20  # cam0 has matched keypoint 0 of cam1, cam2 its twin
    evidence = replace(
        evidence,
        keypoints={**evidence.keypoints, "cam1": twice},
        matches={**evidence.matches, ("cam1", "cam2"): other},
    )
    assert len(build_tracks(evidence, cameras).points) == 19


def test_without_matches_there_are_no_points() -> None:
    cameras = wide_ring(3)
    none = {pair: np.empty((0, 2), np.intp) for pair in (("cam0", "cam1"), ("cam1", "cam2"))}
    tracks = build_tracks(replace(evidence_of(cameras, scattered(5)), matches=none), cameras)
    assert tracks.points.shape == (0, 3)
    assert len(tracks.residuals) == 0


@pytest.mark.parametrize(("count", "behind"), [(5, [0.03]), (7, [0.4]), (7, [0.4, 0.7])])
def test_observations_that_are_off_take_no_point_with_them(count: int, behind: list[float]) -> None:
    """The last cameras see another thing, behind the point by a share, on the same ray of the first camera."""
    cameras, world = wide_ring(count), scattered(30)
    evidence = evidence_of(cameras, world)
    others = [f"cam{count - 1 - number}" for number in range(len(behind))]
    keypoints = {name: pixels.copy() for name, pixels in evidence.keypoints.items()}
    for number, name in enumerate(others):
        thing = world[:1] + behind[number] * (world[:1] - cameras["cam0"].center.numpy())
        keypoints[name][0] = project(cameras[name], thing)[0][0]
    spoiled = [pair for pair in evidence.matches if set(pair) & set(others) and "cam0" not in pair]
    matches = {**evidence.matches, **{pair: evidence.matches[pair][1:] for pair in spoiled}}
    tracks = build_tracks(replace(evidence, keypoints=keypoints, matches=matches), cameras)
    assert len(tracks.points) == 30
    place = tracks.points[tracks.point[tracks.of("cam1")]][truth_of(tracks, evidence, "cam1") == 0]
    np.testing.assert_allclose(place, world[:1], atol=1e-5)
    far = tracks.residuals > 3
    assert sorted(tracks.names[number] for number in tracks.camera[far]) == sorted(others)
    assert tracks.residuals[~far].max() < 1e-4


def test_two_parties_of_one_size_are_not_decided() -> None:
    """On one ray of the first camera two others see one thing, and two another."""
    cameras, world = wide_ring(5), scattered(12)
    evidence = evidence_of(cameras, world)
    behind = world[:1] + 0.5 * (world[:1] - cameras["cam0"].center.numpy())
    keypoints = {name: pixels.copy() for name, pixels in evidence.keypoints.items()}
    for name in ("cam3", "cam4"):
        keypoints[name][0] = project(cameras[name], behind)[0][0]
    parted = [(one, other) for one in ("cam1", "cam2") for other in ("cam3", "cam4")]
    matches = {**evidence.matches, **{pair: evidence.matches[pair][1:] for pair in parted}}
    tracks = build_tracks(replace(evidence, keypoints=keypoints, matches=matches), cameras)
    assert len(tracks.points) == 11
    assert tracks.residuals.max() < 1e-4


WIDTH, FOCAL = 1000, 800.0
PIXELS = np.random.default_rng(0).uniform(200, 700, (40, 2))


def beside(x: float) -> Camera:
    """A camera that looks along z from a place on the x axis, so that epipolar lines are rows."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, WIDTH / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, WIDTH, WIDTH)


@pytest.mark.parametrize(("rows", "share"), [(0.0, 0.0), (5.0, 0.0), (-12.0, 1.0)])
def test_a_match_off_its_line_violates_from_a_hundredth_of_the_width(rows: float, share: float) -> None:
    error = pair_error(beside(0), beside(1), PIXELS, np.add(PIXELS, (-40, rows)))
    assert error.pixels == pytest.approx(abs(rows), abs=1e-9)
    assert (error.share, error.matches) == (share, 40)


def test_the_share_is_of_the_matches_that_violate() -> None:
    other = np.add(PIXELS, (-40, 0))
    other[:10, 1] += 30
    error = pair_error(beside(0), beside(1), PIXELS, other)
    assert error.share == pytest.approx(0.25)
    assert error.pixels == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("columns", "share"), [(40.0, 1.0), (2.0, 0.0)])
def test_rays_that_meet_behind_violate_unless_they_are_nearly_parallel(columns: float, share: float) -> None:
    """On their lines, but moved the wrong way: two of 800 pixels of focal length are 0.14 degrees."""
    error = pair_error(beside(0), beside(1), PIXELS, np.add(PIXELS, (columns, 0)))
    assert error.pixels == pytest.approx(0, abs=1e-9)
    assert error.share == share


def test_true_poses_explain_all_pairs_and_pairs_without_matches_are_left_out() -> None:
    cameras = wide_ring(4)
    found = evidence_of(cameras, scattered(60))
    alone = replace(found, matches={**found.matches, ("cam0", "cam3"): np.empty((0, 2), np.intp)})
    errors = pair_errors(alone, cameras)
    assert set(errors) == set(found.matches) - {("cam0", "cam3")}
    assert max(error.pixels for error in errors.values()) < 1e-6
    assert not any(error.share for error in errors.values())


def test_in_large_rigs_neighbours_are_matched_and_absent_cameras_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = room_rig(7)
    frame = room_frame(rig, textured=False)
    frame = replace(frame, images={name: image for name, image in frame.images.items() if name != "cam06"})
    everything = gather(frame, rig.cameras)
    assert len(everything.matches) == 15
    assert set(everything.keypoints) == set(rig) - {"cam06"}
    monkeypatch.setattr(evidence, "ALL_PAIRS", 5)
    monkeypatch.setattr(evidence, "NEIGHBOURS", 2)
    few = gather(frame, rig.cameras)
    assert {name for pair in few.matches for name in pair} == set(rig) - {"cam06"}
    assert 6 <= len(few.matches) <= 11
    assert not set(few.matches) & {("cam00", "cam05"), ("cam05", "cam00")}
