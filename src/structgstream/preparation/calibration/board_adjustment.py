# SPDX-License-Identifier: Apache-2.0
"""The last adjustment of cameras that saw a board: all together, with what alike lenses share."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from structgstream.data.arrays import Floats
from structgstream.data.lenses import LensCamera
from structgstream.preparation.calibration.adjustment import cameras_in, estimated, posed_problem
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.calibration.board_model import Sightings
from structgstream.preparation.calibration.bundle import Scene, Sights
from structgstream.preparation.calibration.colmap import LensModel
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DISTORTION, DOWN, FOCAL


def adjust_board(
    board: Board,
    sightings: Sightings,
    cameras: Mapping[str, LensCamera],
    poses: Mapping[int, Floats],
    *,
    lens: LensModel,
    known: frozenset[str],
) -> tuple[dict[str, LensCamera], dict[int, Floats]]:
    """Cameras and board-to-world poses ``[4, 4]`` by instant, adjusted together; the first camera is the world.

    Args:
        lens: which distortion is estimated.
        known: cameras whose intrinsics and lens stay.
    """
    number = {instant: index for index, instant in enumerate(poses)}
    seen = [(index, sight) for index, name in enumerate(cameras) for sight in sightings[name]]
    counts = [len(sight.corners) for _, sight in seen]
    sights = Sights(
        np.repeat([index for index, _ in seen], counts).astype(np.intp),
        np.repeat([number[sight.instant] for _, sight in seen], counts).astype(np.intp),
        np.concatenate([board.corners[sight.corners] for _, sight in seen]),
        np.concatenate([sight.pixels for _, sight in seen]),
    )
    stack = np.stack(list(poses.values()))
    bundle, scene = posed_problem(
        list(cameras.values()),
        sights,
        (stack[:, :3, :3], stack[:, :3, 3]),
        lens=np.arange(len(cameras)),
        free=(FOCAL, ASPECT, ACROSS, DOWN, *DISTORTION[lens]),
        held=np.array([name in known for name in cameras]),
        turning=True,
    )
    bundle, scene = estimated(bundle, scene)
    scene = _from_first(scene)
    return cameras_in(scene, cameras, bundle.lens), dict(zip(poses, _matrices(scene.turns, scene.places), strict=True))


def _from_first(scene: Scene) -> Scene:
    """In the axes of the first camera."""
    turn, move = scene.rotations[0], scene.translations[0]
    rotations = scene.rotations @ turn.T
    translations = scene.translations - rotations @ move
    rotations[0], translations[0] = np.eye(3), 0.0  # exactly
    return replace(
        scene,
        rotations=rotations,
        translations=translations,
        turns=turn @ scene.turns,
        places=scene.places @ turn.T + move,
    )


def _matrices(turns: Floats, places: Floats) -> Floats:
    found = np.tile(np.eye(4), (len(turns), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = turns, places
    return found
