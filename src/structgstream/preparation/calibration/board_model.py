# SPDX-License-Identifier: Apache-2.0
"""Sightings of a board as a model of COLMAP's: the board is the world, and the rig moves before it.

The cameras are the sensors of one rig, an instant is a frame of it: a picture's pose is the camera's in the rig times
the rig's before the board. So the poses that still cameras share over all instants are shared in the adjustment, and
the board's corners, which are known, fix its scale.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from structgstream.data.arrays import Floats
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.calibration.board_sightings import Sighting
from structgstream.preparation.calibration.colmap import colmap_pose, pycolmap_module

Sightings = Mapping[str, Sequence[Sighting]]


def board_model(
    board: Board,
    sightings: Sightings,
    cameras: Mapping[str, Any],
    sensors: Mapping[str, Floats],
    rig_poses: Mapping[int, Floats],
) -> Any:
    """The model of all sightings.

    Args:
        cameras: of pycolmap, with the ids 1, 2, ... in the order of the names.
        sensors: rig-to-camera matrices ``[4, 4]``; the first camera is the rig's reference, its matrix the identity.
        rig_poses: instant to the board-to-rig matrix ``[4, 4]``.
    """
    pycolmap = pycolmap_module()
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for name, camera in cameras.items():
        model.add_camera(camera)
        if rig.num_sensors() == 0:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, colmap_pose(sensors[name]))
    model.add_rig(rig)
    black = np.zeros(3, np.uint8)
    places = board.corners
    corners = {index: model.add_point3D(places[index], pycolmap.Track(), black) for index in _repeated(sightings)}
    images: list[tuple[int, str, Sighting]] = []
    for instant, pose in rig_poses.items():
        frame = pycolmap.Frame(frame_id=instant + 1, rig_id=1)
        for name, sights in sightings.items():
            for sight in (sight for sight in sights if sight.instant == instant):
                images.append((len(images) + 1, name, sight))
                frame.add_data_id(pycolmap.data_t(cameras[name].sensor_id, len(images)))
        frame.rig_from_world = colmap_pose(pose)
        model.add_frame(frame)
    for number, name, sight in images:
        image = pycolmap.Image(
            name=f"{name}/{sight.instant}",
            camera_id=cameras[name].camera_id,
            image_id=number,
            frame_id=sight.instant + 1,
        )
        seen = [(pixel, corners[corner]) for pixel, corner in _of_points(sight, corners)]
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel, point) for pixel, point in seen])
        model.add_image(image)
    for instant in rig_poses:
        model.register_frame(instant + 1)
    for number, _, sight in images:
        for index, (_, corner) in enumerate(_of_points(sight, corners)):
            model.point3D(corners[corner]).track.add_element(number, index)
    return model


def _repeated(sightings: Sightings) -> list[int]:
    """The corners that are seen at least twice: COLMAP adjusts no others."""
    seen = [sight.corners for sights in sightings.values() for sight in sights]
    corners, counts = np.unique(np.concatenate(seen), return_counts=True)
    return [int(corner) for corner in corners[counts > 1]]


def _of_points(sight: Sighting, points: Mapping[int, int]) -> list[tuple[Floats, int]]:
    pairs = zip(sight.pixels, sight.corners.tolist(), strict=True)
    return [(pixel, corner) for pixel, corner in pairs if corner in points]


def sensor_poses(model: Any, cameras: Mapping[str, Any]) -> dict[str, Floats]:
    """Rig-to-camera matrices ``[4, 4]``."""
    rig = model.rig(1)
    return {
        name: np.eye(4) if rig.is_ref_sensor(camera.sensor_id) else matrix(rig.sensor_from_rig(camera.sensor_id))
        for name, camera in cameras.items()
    }


def rig_poses(model: Any) -> dict[int, Floats]:
    """Board-to-rig matrices ``[4, 4]`` by instant."""
    return {number - 1: matrix(model.frame(number).rig_from_world) for number in sorted(model.reg_frame_ids())}


def matrix(pose: Any) -> Floats:
    """A rigid motion of pycolmap as ``[4, 4]``."""
    return np.vstack([np.array(pose.matrix()), [0.0, 0.0, 0.0, 1.0]])
