# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.pair_matches import pair_error
from structgstream.pose_check import tracks as evidence
from structgstream.pose_check.tracks import gather, pair_errors
from tests.support.evidence_made import evidence_of, scattered, wide_ring
from tests.support.planes import room_frame, room_rig

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
