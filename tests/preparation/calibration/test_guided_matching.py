# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from structgstream.preparation.calibration import keypoints
from structgstream.preparation.calibration.keypoints import all_matches, guided_matches
from tests.support.repetitive import POINTS, keypoints_of, ring


def test_what_looks_alike_is_distinguished_by_epipolar_lines() -> None:
    cameras = ring()
    keypoints = keypoints_of(cameras)
    alone = all_matches(keypoints, workers=1)
    guided = guided_matches(keypoints, cameras, pixels=2.0, workers=1)
    pair = ("cam0", "cam1")
    assert len(alone[pair]) < 0.1 * POINTS
    assert len(guided[pair]) > 0.5 * POINTS
    right = guided[pair][:, 0] == guided[pair][:, 1]
    assert right.mean() > 0.95


def test_matches_share_an_instant() -> None:
    cameras = {name: filmed for name, filmed in ring().items() if name in ("cam0", "cam1")}
    keypoints = keypoints_of(cameras)
    early = np.stack([np.arange(POINTS) % 2 == 0, np.arange(POINTS) % 2 == 1], 1)
    both = {
        "cam0": replace(keypoints["cam0"], seen=early),
        "cam1": replace(keypoints["cam1"], seen=early[:, ::-1]),
    }
    found = guided_matches(both, cameras, pixels=2.0, workers=1)["cam0", "cam1"]
    assert not (found[:, 0] == found[:, 1]).any()


def test_cameras_that_look_apart_are_not_matched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keypoints, "FACING_DEGREES", 20.0)
    cameras = ring()
    found = guided_matches(keypoints_of(cameras), cameras, pixels=2.0, workers=1)
    assert ("cam0", "cam1") in found
    assert ("cam0", "cam5") not in found


def test_cameras_of_one_place_have_no_planes() -> None:
    camera = ring()["cam0"]
    both = {"one": camera, "two": camera}
    assert len(guided_matches(keypoints_of(both), both, pixels=2.0, workers=1)["one", "two"]) == 0


def test_no_keypoints_give_no_matches() -> None:
    cameras = {name: filmed for name, filmed in ring().items() if name in ("cam0", "cam1")}
    keypoints = keypoints_of(cameras)
    own = keypoints["cam1"]
    none = replace(own, pixels=own.pixels[:0], descriptors=own.descriptors[:0], seen=own.seen[:0])
    assert len(guided_matches(keypoints | {"cam1": none}, cameras, pixels=2.0, workers=1)["cam0", "cam1"]) == 0
