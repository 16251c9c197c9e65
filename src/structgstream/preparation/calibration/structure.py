# SPDX-License-Identifier: Apache-2.0
"""Structure from motion: cameras of a rig from what their pictures have in common, and given ones refined by it.

A camera that stands still is one image with the keypoints of all its instants (``keypoints.py``), so that people who
move about give matches where walls are bare. Keypoints and their matches are ours, the model is COLMAP's (Schönberger
and Frahm, CVPR 2016; Pan et al., ECCV 2024 for the global one).
"""

import logging
import math
import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from structgstream.data.calibration import listed
from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair, connected_groups
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration.bundle import adjust_together, chosen, inlier_pixels
from structgstream.preparation.calibration.colmap import MODELS, field_of_view, guessed_camera, holding, pycolmap_module
from structgstream.preparation.calibration.keypoints import (
    Keypoints,
    all_keypoints,
    all_matches,
    epipolar_pixels,
    roving_keypoints,
)
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DISTORTION, DOWN, FOCAL, LensModel
from structgstream.preparation.calibration.mapping import (
    Matches,
    PosedGraph,
    adjust,
    cameras_of,
    filter_model,
    mapped,
    observed,
    placed_in,
    posed_graph,
    posed_model,
    rematched,
    size_of,
    triangulated,
    verified_pairs,
    without,
    write_database,
)
from structgstream.preparation.calibration.solved import RovingFrames, SolvedCalibration, normalized, rig_alignment

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
"""Degrees across the longer side that are tried in this order, after the focal lengths that cameras state, until one
places all cameras (:func:`_best_attempt`)."""


def solve_structure(
    pictures: Pictures,
    *,
    lens: LensModel = "radial",
    intrinsics: Intrinsics = "own",
    focals: Mapping[str, float] | None = None,
    roving: Mapping[str, NDArray[np.uint8]] | None = None,
) -> SolvedCalibration:
    """Poses, intrinsics and lenses of still cameras from their own pictures.

    Args:
        pictures: camera name, of three or more, to pictures ``[H, W, 3]`` of the same instants for all cameras, in
            order of time.
        lens: which distortion is estimated.
        intrinsics: ``"shared"`` for cameras of one make and zoom, else ``"own"``.
        focals: focal lengths in pixels by name, of those cameras that state one. Fields of view that are tried begin
            with these; cameras that state none take the median one.
        roving: frames ``[H, W, 3]`` of one more camera, which was walked through the set at any time, in their order.
            They have one lens; a rolling shutter is ignored.

    Returns:
        the calibration in arbitrary units: the axes are those of the first camera, the mean camera is the origin, and
        the farthest one is one unit away from it. Cameras that see too little in common with the others are
        ``missing``. Points and observations are those of the still cameras.

    Raises:
        CalibrationError: fewer than three cameras can be placed, or no roving frame; or shared intrinsics are asked for
            pictures of several sizes.
    """
    pycolmap_module()
    keypoints = all_keypoints(pictures)
    matches = all_matches(keypoints)
    sizes = {name: (shots[0].shape[1], shots[0].shape[0]) for name, shots in pictures.items()}
    starts = _starts(sizes, lens, intrinsics, focals or {})
    alone = best = _best_attempt(keypoints, matches, starts, stills=pictures)
    frames: Mapping[str, NDArray[np.uint8]] = roving or {}
    if frames:
        instants = next(iter(keypoints.values())).seen.shape[1]
        keypoints = {**keypoints, **roving_keypoints(frames, instants=instants)}
        matches = {**matches, **all_matches(keypoints, _roving_pairs([*pictures], [*frames]))}
        starts = [_with_roving(start, frames, lens) for start in starts]
        best = _best_attempt(keypoints, matches, starts, stills=pictures)
        if best.size[0] == 0 or best.size[0] == best.size[1]:
            raise CalibrationError(_no_roving_message(keypoints, matches, best.pairs, [*frames]))
        if best.size[0] < 3:
            raise CalibrationError(
                f"The roving video connects {best.size[0]} of {len(pictures)} cameras, fewer than three; walk slowly "
                "from the view of each camera to that of the next, around the whole set."
            )
    if best.model is None or best.size[0] < 3:
        raise CalibrationError(_no_model_message(pictures, matches, best.pairs))
    solved = _finished(best, keypoints, pictures, frames, lens=lens)
    if solved.roving is not None:
        placed = [] if alone.model is None else placed_in(alone.model)
        bridged = tuple(name for name in solved.cameras if name not in placed)
        solved = replace(solved, roving=replace(solved.roving, bridged=bridged))
    if solved.missing:
        _log.warning("%s", missing_cameras(solved.missing, matches, best.pairs))
    return solved


NEIGHBOURS = 4  # frames of a roving camera that are matched with the next so many
ENOUGH_ROVING = 0.5  # share of the roving frames that a start places, with all still cameras, for no other to be tried


@dataclass(frozen=True)
class _Attempt:
    """A model from one start, None without one, and the pairs that it is made from."""

    model: Any | None
    pairs: Mapping[Pair, Any]
    size: tuple[int, int, int] = (0, 0, 0)  # of the model


def _best_attempt(
    keypoints: Mapping[str, Keypoints],
    matches: Matches,
    starts: Sequence[Mapping[str, Any]],
    *,
    stills: Collection[str],
) -> _Attempt:
    """The attempt with the largest model; no further start is tried once one places all still cameras and enough roving
    frames."""
    best: _Attempt | None = None
    enough = len(stills) + ENOUGH_ROVING * (len(starts[0]) - len(stills))
    for cameras in starts:
        attempt = _attempt(keypoints, matches, cameras, stills=stills)
        best = attempt if best is None or attempt.size > best.size else best
        if best.size[0] == len(stills) and best.size[1] >= enough:
            break
    assert best is not None
    return best


def _roving_pairs(stills: Sequence[str], frames: Sequence[str]) -> list[Pair]:
    """Every still camera with every frame, and every frame with the next ones."""
    following = [(one, two) for index, one in enumerate(frames) for two in frames[index + 1 : index + 1 + NEIGHBOURS]]
    return [*product(stills, frames), *following]


def _with_roving(
    start: Mapping[str, Any], frames: Mapping[str, NDArray[np.uint8]], lens: LensModel
) -> Mapping[str, Any]:
    """The cameras to begin with, and one for all frames, of the median field of view of the others."""
    degrees = [
        field_of_view(lens, camera.mean_focal_length(), (camera.width, camera.height)) for camera in start.values()
    ]
    height, width = next(iter(frames.values())).shape[:2]
    number = 1 + max(camera.camera_id for camera in start.values())
    return {**start, **dict.fromkeys(frames, guessed_camera(lens, number, (width, height), float(np.median(degrees))))}


def _no_roving_message(
    keypoints: Mapping[str, Keypoints], matches: Matches, pairs: Mapping[Pair, Any], frames: Sequence[str]
) -> str:
    """Why no frame of the roving camera could be placed."""
    walked = np.median([len(keypoints[name]) for name in frames])
    still = np.median([len(own) for name, own in keypoints.items() if name not in frames])
    if walked < BLURRED * still:
        return (
            f"The roving video is blurred, or of bare surfaces: its sharpest frames have {walked:.0f} keypoints, the "
            f"cameras {still:.0f}; walk slower, with more light and what the cameras see, or leave out --roving."
        )
    with_stills = [pair for pair in matches if (pair[0] in frames) != (pair[1] in frames)]
    best = max((_agreeing(pairs, pair) for pair in with_stills), default=0)
    return (
        f"No roving frame can be placed among the cameras (at best {best} matches agree between a frame and a camera): "
        "film the same set, with what the cameras see in view, or leave out --roving."
    )


BLURRED = 0.2  # share of the keypoints of a still camera below which roving frames are blurred
REMEDY = (
    "Let neighbouring cameras see more of the same, let people walk about in the take, or film a board "
    "(structgstream board)."
)


def _agreeing(pairs: Mapping[Pair, Any], pair: Pair) -> int:
    """Number of matches of a pair that agree."""
    return len(pairs[pair].inlier_matches) if pair in pairs else 0


def missing_cameras(missing: Sequence[str], matches: Matches, pairs: Mapping[Pair, Any]) -> str:
    """One sentence for each camera that could not be placed: with whom it has how many matches."""
    reasons = []
    for name in missing:
        best = sorted((pair for pair in matches if name in pair), key=lambda pair: -_agreeing(pairs, pair))[:2]
        others = [next(other for other in pair if other != name) for pair in best]
        agree = " and ".join(
            f"{_agreeing(pairs, pair)} of {len(matches[pair])} matches with {other!r}"
            for pair, other in zip(best, others, strict=True)
        )
        reasons.append(f"{name!r} ({agree} agree)")
    return (
        f"{listed(missing)} could not be placed: {'; '.join(reasons)}. Let neighbouring cameras see more of the same "
        "from at most 30 degrees apart, let people walk about in the take, or film a board (structgstream board)."
    )


def _starts(
    sizes: Mapping[str, tuple[int, int]], lens: LensModel, intrinsics: Intrinsics, focals: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Cameras of pycolmap to begin with, for each start that is tried."""
    if intrinsics == "shared" and len(set(sizes.values())) > 1:
        raise CalibrationError(
            "Shared intrinsics need pictures of one size, got "
            f"{', '.join(sorted({f'{w}x{h}' for w, h in sizes.values()}))}; use own intrinsics."
        )
    tried = [dict.fromkeys(sizes, degrees) for degrees in FIELDS_OF_VIEW[lens]]
    if likely := {name: field_of_view(lens, focal, sizes[name]) for name, focal in focals.items() if name in sizes}:
        middle = float(np.median(list(likely.values())))
        tried.insert(0, {name: likely.get(name, middle) for name in sizes})
    if intrinsics == "shared":
        tried = [dict.fromkeys(sizes, float(np.median(list(degrees.values())))) for degrees in tried]
    numbers = {name: 1 if intrinsics == "shared" else number for number, name in enumerate(sizes, 1)}
    return [
        {name: guessed_camera(lens, numbers[name], size, degrees[name]) for name, size in sizes.items()}
        for degrees in tried
    ]


def _attempt(
    keypoints: Mapping[str, Keypoints],
    matches: Matches,
    cameras: Mapping[str, Any],
    *,
    stills: Collection[str],
) -> _Attempt:
    """The incremental model; if that lacks still cameras that pairs connect, the larger of it and the global one."""
    pairs = verified_pairs(keypoints, matches, cameras)
    attempt = _Attempt(None, pairs)
    if not pairs:
        return attempt
    with tempfile.TemporaryDirectory(prefix="structgstream-sfm-") as folder:
        database = Path(folder) / "database.db"
        write_database(database, keypoints, cameras, pairs)
        reachable = max(sum(name in stills for name in group) for group in connected_groups(keypoints, pairs))
        for mapper in ("incremental", "global"):
            found = mapped(database, mapper=mapper, stills=stills)
            if found is not None and size_of(found, stills) > attempt.size:
                attempt = replace(attempt, model=found, size=size_of(found, stills))
            if attempt.size[0] == reachable:
                break
    return attempt


def _finished(
    attempt: _Attempt,
    keypoints: Mapping[str, Keypoints],
    pictures: Pictures,
    roving: Mapping[str, NDArray[np.uint8]],
    *,
    lens: LensModel,
) -> SolvedCalibration:
    """The model with all intrinsics adjusted, without outliers, in normalised coordinates.

    Without roving frames it is matched again (:func:`rematched`); with them every camera has enough matches.
    """
    model = attempt.model
    assert model is not None
    longest = max(max(shots[0].shape[:2]) for shots in pictures.values())
    pixels = inlier_pixels(longest)
    for _ in range(2):
        adjust(model)
        filter_model(model, pixels=pixels)
    found = cameras_of(model)
    cameras = {name: found[name] for name in (*pictures, *roving) if name in found}
    points, observations = observed(model, keypoints, cameras)
    missing = tuple(name for name in pictures if name not in found)
    rough = SolvedCalibration(cameras, points, observations, missing)
    numbers = {image.name: image.camera_id for image in map(model.image, model.reg_image_ids())}
    lenses = sorted(set(numbers.values()))
    adjusted = partial(
        adjust_together,
        lens=[lenses.index(numbers[name]) for name in cameras],
        free=(FOCAL, ASPECT, ACROSS, DOWN, *DISTORTION[lens]),
        pixels=pixels,
        makes=[name in roving for name in cameras] if roving else None,
    )
    if roving:
        return normalized(_split(adjusted(normalized(rough)), roving))
    return normalized(rematched(normalized(adjusted(rough)), keypoints, pixels=pixels, adjust=adjusted))


def _split(found: SolvedCalibration, roving: Collection[str]) -> SolvedCalibration:
    """The still cameras, with the roving frames apart."""
    names = [*found.cameras]
    walked = np.array([name in roving for name in names])[found.observations.camera]
    errors = found.errors()[walked]
    frames = {name: filmed for name, filmed in found.cameras.items() if name in roving}
    still = chosen(found, ~walked)  # the still cameras come first, so their numbers stay
    return replace(
        still,
        cameras={name: filmed for name, filmed in found.cameras.items() if name not in roving},
        roving=RovingFrames(frames, len(roving), float(np.median(errors)) if len(errors) else math.nan),
    )


def _no_model_message(pictures: Pictures, matches: Matches, pairs: Mapping[Pair, Any]) -> str:
    """Why no three cameras could be placed."""
    if alone := [name for name in pictures if not any(name in pair for pair in pairs)]:
        reason = (
            f"Too few cameras see anything in common: {listed(alone)} {'has' if len(alone) == 1 else 'have'} no pair "
            f"with enough matches that agree ({len(pairs)} of {len(matches)} pairs have)"
        )
    else:
        groups = connected_groups(pictures, pairs)
        reason = (
            f"The pictures of {len(pictures)} cameras give no model: {len(pairs)} of {len(matches)} pairs have matches "
            f"that agree, in {len(groups)} groups ({'; '.join(', '.join(group) for group in groups[:4])})"
        )
    return f"{reason}. {REMEDY}"


SLACK_DEGREES = 1.5  # of matches to the epipolar planes of the given poses, so how wrong these may be
ROUNDS = (1.0, 0.4, 0.2)  # shares of the slack
HELD_OUT_TRACKS = 5  # one in five tracks judges and is not adjusted
MIN_HELD_OUT = 30


@dataclass(frozen=True)
class Refinement:
    """The result of a refinement."""

    solved: SolvedCalibration
    """Refined cameras, in the coordinates of the given ones; these themselves if refining did not help."""
    before_pixels: float  # median distance of matches that were held out to the epipolar lines of the given cameras
    after_pixels: float  # the same of the refined cameras, before they are adjusted to these matches, too
    held_out: int  # number of these matches
    changed: bool  # whether ``solved`` has refined cameras


def refine(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    cameras: Mapping[str, LensCamera],
    *,
    lens: LensModel | None = None,
    metres: bool = False,
) -> Refinement:
    """Adjust ``cameras`` to pictures of the same instants; ``metres`` if they are in metres.

    One track in five is held out. Only if the refined cameras fit these better than the given ones do, they are
    returned, after a last adjustment to all tracks (bundle.py); they are moved, turned and scaled to lie as close to
    the given ones as they can.

    Args:
        lens: the model of lenses, not ``brown``, whose distortion is estimated, too; by default the given distortion
            stays, and only poses and focal lengths move.

    Raises:
        CalibrationError: too few matches agree with the given poses, or not all cameras are connected by them.
    """
    graph = posed_graph(pictures, cameras, slack_degrees=SLACK_DEGREES)
    _check_connected(cameras, graph)
    judging = _held_out(graph)
    learning = without(graph, judging)
    judges = {pair: graph.matches[pair][judging[pair]] for pair in graph.matches}
    refined = dict(cameras)
    models = {name: MODELS[lens] if lens else holding(filmed.lens) for name, filmed in cameras.items()}
    pixels = inlier_pixels(max(max(filmed.camera.width, filmed.camera.height) for filmed in cameras.values()))
    model = None
    for share in ROUNDS:
        slack = SLACK_DEGREES * share
        focal = max(float(filmed.camera.K[0, 0]) for filmed in refined.values())
        loose = max(pixels, focal * float(np.radians(slack)))
        model = posed_model(learning, refined, pixels=loose, slack_degrees=slack, models=models)
        adjust(model, lens=lens is not None)
        filter_model(model, pixels=pixels)
        adjust(model, lens=lens is not None)
        found = cameras_of(model)
        refined = {name: found[name] for name in cameras}
    result = SolvedCalibration(refined, *observed(model, graph.keypoints, cameras))
    result = result.aligned(rig_alignment(refined, cameras), metres=metres)
    before, after = (_judged(graph, judges, which) for which in (cameras, result.cameras))
    count = sum(map(len, judges.values()))
    if after < before:
        terms = (FOCAL, ASPECT, *(DISTORTION[lens] if lens else ()))
        # All tracks, the held-out ones included, with what alike lenses share.
        everything = normalized(triangulated(graph, result.cameras, pixels=pixels))
        everything = adjust_together(everything, lens=range(len(cameras)), free=terms, pixels=pixels)
        everything = everything.aligned(rig_alignment(everything.cameras, cameras), metres=metres)
        if _judged(graph, judges, everything.cameras) <= after:
            result = everything
        return Refinement(result, before, after, count, True)
    _log.warning(
        "Refining does not help: matches that were held out are %.2f pixels off with the given cameras and %.2f with "
        "refined ones; the given ones stay.", before, after,
    )  # fmt: skip
    given = triangulated(graph, cameras, pixels=pixels)
    return Refinement(replace(given, metres=metres), before, after, count, False)


def _check_connected(cameras: Mapping[str, LensCamera], graph: PosedGraph) -> None:
    groups = connected_groups(cameras, graph.matches)
    if len(groups) > 1:
        alone = ", ".join(repr(name) for group in groups[1:] for name in group)
        raise CalibrationError(
            f"Too few matches agree with the given poses of {alone} to refine them with the others: the poses are off "
            "by more than the refinement reaches, cameras are mixed up, or they see too little in common."
        )


def _held_out(graph: PosedGraph) -> dict[Pair, NDArray[np.bool_]]:
    """Which matches belong to the tracks that judge; a track is all keypoints that matches connect."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    starts = dict(zip(graph.keypoints, np.cumsum([0, *map(len, graph.keypoints.values())])))
    total = sum(map(len, graph.keypoints.values()))
    ends = [
        (starts[one] + found[:, 0].astype(np.intp), starts[two] + found[:, 1].astype(np.intp))
        for (one, two), found in graph.matches.items()
    ]
    first, second = (np.concatenate(side) for side in zip(*ends, strict=True))
    links = coo_array((np.ones(len(first)), (first, second)), shape=(total, total))
    _, track = connected_components(links, directed=False)
    # A track's number follows the order of its first keypoint; a shuffle spreads those that judge.
    chosen = np.random.default_rng(0).permutation(track.max() + 1) % HELD_OUT_TRACKS == 0
    judging = {pair: chosen[track[one]] for pair, (one, _) in zip(graph.matches, ends, strict=True)}
    if sum(int(fixed.sum()) for fixed in judging.values()) < MIN_HELD_OUT:
        raise CalibrationError(
            f"Only {len(first)} matches agree with the given poses, too few to refine them: let people walk about "
            "in the take, or let neighbouring cameras see more of the same."
        )
    return judging


def _judged(graph: PosedGraph, judges: Mapping[Pair, NDArray[np.uint32]], cameras: Mapping[str, LensCamera]) -> float:
    errors = epipolar_pixels(graph.keypoints, judges, cameras)
    return float(np.nanmedian(np.concatenate(list(errors.values()))))
