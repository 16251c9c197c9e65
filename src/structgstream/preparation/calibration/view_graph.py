# SPDX-License-Identifier: Apache-2.0
"""Pairs of cameras whose matches agree with one geometry, and the database from which COLMAP builds a model."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.matching import Pair
from structgstream.preparation.calibration.colmap import pycolmap_module
from structgstream.preparation.calibration.keypoints import Keypoints

Matches = Mapping[Pair, NDArray[np.uint32]]


MAX_PIXELS = 3.0  # epipolar distance of a match, for pictures of 1000 pixels on the longer side; never under 1
MIN_MATCHES = 20  # that agree
MIN_SHARE = 0.3
"""Smallest share of a pair's matches that agree. In rigs with repetitive walls nearly all pairs have some matches that
agree by chance; among those of 0.3 and more nearly all were right."""
MAX_TRIALS = 2000  # samples of the robust estimation


def verified_pairs(
    keypoints: Mapping[str, Keypoints],
    matches: Matches,
    cameras: Mapping[str, Any],
    *,
    workers: int,
) -> dict[Pair, Any]:
    """Two-view geometries of the pairs that pass, with the matches that agree.

    Args:
        cameras: of pycolmap, with the focal lengths to begin with.
    """
    pycolmap = pycolmap_module()

    def estimate(pair: Pair) -> Any:
        one, two = (cameras[name] for name in pair)
        options = pycolmap.TwoViewGeometryOptions()
        options.min_num_inliers = MIN_MATCHES
        options.detect_watermark = False
        options.compute_relative_pose = True
        options.ransac.random_seed = 0
        options.ransac.max_num_trials = MAX_TRIALS
        options.ransac.max_error = max(1.0, MAX_PIXELS * max(one.width, one.height, two.width, two.height) / 1000)
        return pycolmap.estimate_two_view_geometry(
            one, keypoints[pair[0]].pixels, two, keypoints[pair[1]].pixels, matches[pair], options
        )

    pairs = [pair for pair, found in matches.items() if len(found) >= MIN_MATCHES]
    with ThreadPoolExecutor(workers) as pool:
        found = dict(zip(pairs, pool.map(estimate, pairs), strict=True))
    return {
        pair: geometry
        for pair, geometry in found.items()
        if len(geometry.inlier_matches) >= max(MIN_MATCHES, MIN_SHARE * len(matches[pair]))
    }


def write_database(
    path: Path, keypoints: Mapping[str, Keypoints], cameras: Mapping[str, Any], geometries: Mapping[Pair, Any]
) -> dict[str, int]:
    """A database of COLMAP's with an image per camera; returns the ids of the images.

    Cameras of one id are one camera with shared intrinsics.
    """
    pycolmap = pycolmap_module()
    number = {name: index for index, name in enumerate(keypoints, 1)}
    with pycolmap.Database.open(path) as database:
        for camera in {camera.camera_id: camera for camera in cameras.values()}.values():
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for name, index in number.items():
            image = pycolmap.Image(name=name, camera_id=cameras[name].camera_id, image_id=index)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=index, rig_id=cameras[name].camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(index, keypoints[name].pixels.astype(np.float32))
        for (one, two), geometry in geometries.items():
            database.write_matches(number[one], number[two], geometry.inlier_matches)
            database.write_two_view_geometry(number[one], number[two], geometry)
    return number
