# SPDX-License-Identifier: Apache-2.0
"""Structure from motion: cameras of a rig from what their pictures have in common.

A camera that stands still is one image with the keypoints of all its instants (``keypoints.py``), so that people who
move about give matches where walls are bare. Keypoints and their matches are ours, the model is COLMAP's (Schönberger
and Frahm, CVPR 2016; Pan et al., ECCV 2024 for the global one).
"""

import logging
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from structgstream.data.calibration import listed
from structgstream.data.matching import Pair, connected_groups
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration.adjustment import Limits, adjust_together
from structgstream.preparation.calibration.colmap import (
    LensModel,
    field_of_view,
    guessed_camera,
    pycolmap_module,
)
from structgstream.preparation.calibration.keypoints import Keypoints, all_keypoints
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DISTORTION, DOWN, FOCAL
from structgstream.preparation.calibration.mapping import (
    Matches,
    adjust,
    cameras_of,
    filtered,
    mapped,
    observed,
    size_of,
    verified_pairs,
    write_database,
)
from structgstream.preparation.calibration.matching import all_matches
from structgstream.preparation.calibration.solved import SolvedCalibration, normalized
from structgstream.preparation.calibration.triangulation import rematched

_log = logging.getLogger(__name__)

Pictures = Mapping[str, Sequence[NDArray[np.uint8]]]
Intrinsics = Literal["own", "shared"]

FIELDS_OF_VIEW: Mapping[LensModel, tuple[float, ...]] = {
    "pinhole": (60.0, 40.0, 85.0),
    "radial": (60.0, 40.0, 85.0),
    "opencv": (60.0, 85.0, 40.0),
    "brown": (60.0, 85.0, 40.0),
    "fisheye": (120.0, 150.0, 90.0, 170.0),
}
"""Degrees across the longer side that are tried where none is given, until one places all cameras."""


def solve_structure(
    pictures: Pictures,
    *,
    lens: LensModel = "radial",
    intrinsics: Intrinsics = "own",
    focals: Mapping[str, float] | None = None,
) -> SolvedCalibration:
    """Poses, intrinsics and lenses of still cameras from their own pictures.

    Args:
        pictures: camera name to pictures ``[H, W, 3]`` of the same instants for all cameras, in order of time.
        lens: which distortion is estimated.
        intrinsics: ``"shared"`` for cameras of one make and zoom, else ``"own"``.
        focals: focal lengths in pixels by name, of those cameras that state one. Fields of view that are tried begin
            with these; cameras that state none take the median one.

    Returns:
        the calibration in arbitrary units: the mean camera is the origin and the farthest is one unit away, as the
        axes of the first camera. Cameras that see too little in common with the others are ``missing``.

    Raises:
        CalibrationError: fewer than three cameras, pictures that do not belong together, or too little in common.
    """
    pycolmap_module()
    if len(pictures) < 3:
        raise CalibrationError(
            f"Structure from motion needs three cameras or more, got {listed(pictures)}: two of them do not fix "
            "their focal lengths; film a board with both (structgstream board), or add a camera."
        )
    workers = max(1, min(len(pictures), os.cpu_count() or 1))
    keypoints = all_keypoints(pictures, workers=workers)
    matches = all_matches(keypoints, workers=workers)
    best: _Attempt | None = None
    sizes = {name: (shots[0].shape[1], shots[0].shape[0]) for name, shots in pictures.items()}
    for cameras in _starts(sizes, lens, intrinsics, _fields_of_view(sizes, lens, focals or {})):
        attempt = _attempt(keypoints, matches, cameras, workers=workers)
        best = attempt if best is None or attempt.size > best.size else best
        if best.size[0] == len(pictures):
            break
    assert best is not None
    if best.model is None or best.size[0] < 3:
        raise CalibrationError(_nothing(pictures, matches, best.pairs))
    solved = _finished(best, keypoints, pictures, lens=lens, workers=workers)
    if solved.missing:
        _log.warning("%s", missing_cameras(solved.missing, matches, best.pairs))
    return solved


def missing_cameras(missing: Sequence[str], matches: Matches, pairs: Mapping[Pair, Any]) -> str:
    """One sentence for each camera that could not be placed: with whom it has how many matches."""
    reasons = []
    for name in missing:
        others = {
            (two if name == one else one): _agreeing((one, two), matches, pairs)
            for one, two in matches
            if name in (one, two)
        }
        best = sorted(others, key=lambda other: -others[other][0])[:2]
        best_pairs = " and ".join(f"{others[other][0]} of {others[other][1]} matches with {other!r}" for other in best)
        reasons.append(f"{name!r} ({best_pairs} agree)")
    return (
        f"{listed(missing)} could not be placed: {'; '.join(reasons)}. Let neighbouring cameras see more of the same "
        "from at most 30 degrees apart, take more instants, or film a board (structgstream board)."
    )


@dataclass(frozen=True)
class _Attempt:
    """A model from one start, None without one, and the pairs that it is made from."""

    model: Any | None
    pairs: Mapping[Pair, Any]

    @property
    def size(self) -> tuple[int, int]:
        return (0, 0) if self.model is None else size_of(self.model)


def _fields_of_view(
    sizes: Mapping[str, tuple[int, int]],
    lens: LensModel,
    focals: Mapping[str, float],
) -> list[dict[str, float]]:
    """Degrees by camera, for each start that is tried."""
    tried = [dict.fromkeys(sizes, degrees) for degrees in FIELDS_OF_VIEW[lens]]
    if likely := {name: field_of_view(lens, focal, sizes[name]) for name, focal in focals.items() if name in sizes}:
        middle = float(np.median(list(likely.values())))
        tried.insert(0, {name: likely.get(name, middle) for name in sizes})
    return tried


def _starts(
    sizes: Mapping[str, tuple[int, int]],
    lens: LensModel,
    intrinsics: Intrinsics,
    tried: Sequence[Mapping[str, float]],
) -> list[dict[str, Any]]:
    """Cameras of pycolmap to begin with, for each start that is tried."""
    if intrinsics == "shared" and len(set(sizes.values())) > 1:
        raise CalibrationError(
            "Shared intrinsics need pictures of one size, got "
            f"{', '.join(sorted({f'{w}x{h}' for w, h in sizes.values()}))}; use own intrinsics."
        )
    starts = []
    for degrees in tried:
        middle = float(np.median(list(degrees.values())))
        cameras = {}
        for number, (name, size) in enumerate(sizes.items(), 1):
            if intrinsics == "shared":
                cameras[name] = guessed_camera(lens, 1, size, middle)
            else:
                cameras[name] = guessed_camera(lens, number, size, degrees[name])
        starts.append(cameras)
    return starts


def _attempt(
    keypoints: Mapping[str, Keypoints],
    matches: Matches,
    cameras: Mapping[str, Any],
    *,
    workers: int,
) -> _Attempt:
    """The incremental model, or the global one if that places more cameras."""
    pairs = verified_pairs(keypoints, matches, cameras, workers=workers)
    attempt = _Attempt(None, pairs)
    if not pairs:
        return attempt
    with tempfile.TemporaryDirectory(prefix="structgstream-sfm-") as folder:
        database = Path(folder) / "database.db"
        write_database(database, keypoints, cameras, pairs)
        reachable = len(connected_groups(keypoints, pairs)[0])
        for mapper in ("incremental", "global"):
            found = mapped(database, mapper=mapper)
            if found is not None and size_of(found) > attempt.size:
                attempt = replace(attempt, model=found)
            if attempt.size[0] == reachable:
                break
    return attempt


def _finished(
    attempt: _Attempt,
    keypoints: Mapping[str, Keypoints],
    pictures: Pictures,
    *,
    lens: LensModel,
    workers: int,
) -> SolvedCalibration:
    """The model with all intrinsics adjusted, matched again, without outliers, in normalised coordinates."""
    model = attempt.model
    assert model is not None
    longest = max(max(shots[0].shape[:2]) for shots in pictures.values())
    limits = Limits.for_pictures(longest)
    for _ in range(2):
        adjust(model)
        filtered(model, pixels=limits.pixels, degrees=limits.degrees)
    found = cameras_of(model)
    cameras = {name: found[name] for name in pictures if name in found}
    points, observations = observed(model, keypoints, cameras)
    missing = tuple(name for name in pictures if name not in found)
    rough = SolvedCalibration(cameras, points, observations, missing)
    numbers = {image.name: image.camera_id for image in map(model.image, model.reg_image_ids())}
    lenses = sorted(set(numbers.values()))
    adjusted = partial(
        adjust_together,
        lens=[lenses.index(numbers[name]) for name in cameras],
        free=(FOCAL, ASPECT, ACROSS, DOWN, *DISTORTION[lens]),
        limits=limits,
    )
    return normalized(
        rematched(normalized(adjusted(rough)), keypoints, limits=limits, adjust=adjusted, workers=workers)
    )


def _agreeing(pair: Pair, matches: Matches, pairs: Mapping[Pair, Any]) -> tuple[int, int]:
    return (len(pairs[pair].inlier_matches) if pair in pairs else 0), len(matches[pair])


def _nothing(pictures: Pictures, matches: Matches, pairs: Mapping[Pair, Any]) -> str:
    alone = [name for name in pictures if not any(name in pair for pair in pairs)]
    if not alone:
        groups = connected_groups(pictures, pairs)
        return (
            f"The pictures of {len(pictures)} cameras give no model: {len(pairs)} of {len(matches)} pairs have matches "
            f"that agree, in {len(groups)} groups ({'; '.join(', '.join(group) for group in groups[:4])}). Let "
            "neighbouring cameras see more of the same, take more instants, or film a board (structgstream board)."
        )
    has = "has" if len(alone) == 1 else "have"
    return (
        f"Too few cameras see anything in common: {listed(alone)} {has} no pair with enough matches that agree "
        f"({len(pairs)} of {len(matches)} pairs have). Let neighbouring cameras see more of the same, take more "
        "instants, or film a board (structgstream board)."
    )
