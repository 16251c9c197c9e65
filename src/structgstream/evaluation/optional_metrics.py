# SPDX-License-Identifier: Apache-2.0
"""Metrics with requirements: OpenCV, weights, the size of pictures, or the previous frame.

Without OpenCV there are none of them. If another requirement is missing, the metric is None, and the reason and its
remedy are reported once. Temporal metrics compare consecutive frames of one camera by the optical flow between them.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.evaluation.flip import FlipFeatures, features_of, flip_of
from structgstream.evaluation.lpips import ALEX, TRUNKS, VGG, Features, Lpips, how_to_get, load_lpips, weights_file
from structgstream.evaluation.metrics import SMALLEST_OF_SCALES, Mask, Picture, both, changed_pixels, ms_ssim
from structgstream.flow import FlowSearch, consistency_mask, dis_search, sampled


def warping_error(now: Picture, before: Picture, backward: NDArray[np.float32], seen: Mask) -> float | None:
    """E_warp of one pair: the mean squared difference of a rendering and the warped previous rendering.

    ``before`` is warped by the truth's flow ``backward`` ``[H, W, 2]``, x and y in pixels: pixel p was at
    ``p + backward[p]`` in the frame before. The mean is over channels and over the pixels ``seen`` ``[H, W]``, which
    were not occluded. Pictures are ``[H, W, 3]`` uint8, full scale 1. None if all pixels were occluded.

    Source: Lai et al., 2018, whose sum over channels is a mean here.
    """
    if not seen.any():
        return None
    carried = sampled(before.astype(np.float32), backward)
    squares = np.square(carried - now)[seen]
    return float(squares.mean(dtype=np.float64)) / 255.0**2


def flicker(now: Picture, before: Picture, still: Mask) -> float | None:
    """Mean absolute difference of two consecutive pictures over the static pixels ``still`` ``[H, W]``, in levels of
    1/255.

    None without static pixels.
    """
    count = int(np.count_nonzero(still))
    if not count:
        return None
    difference = np.abs(np.subtract(now, before, dtype=np.int16)).sum(2, dtype=np.int32)
    return int(np.sum(difference, where=still, dtype=np.int64)) / (3 * count)


MetricSelection = Literal["all", "basic"]
"""All metrics, or only the cheap ones: PSNR and its variants, SSIM, and ghosts."""

OF_WHOLE_PICTURES = ("ms_ssim", "lpips_alex", "lpips_vgg", "temporal_flip", "t_lpips")
TEMPORAL = ("e_warp", "temporal_flip", "t_lpips", "flicker", "truth_flicker")


@dataclass(frozen=True)
class OptionalMetrics:
    """The available metrics, and the reasons for missing ones."""

    search: FlowSearch  # finds optical flow
    lpips: Mapping[str, Lpips]  # the trunks whose weights were found, by name
    weights: Mapping[str, str] = field(default_factory=dict)  # the file of each trunk's weights, by name of the trunk
    not_available: Mapping[str, str] = field(default_factory=dict)  # the reason for each missing metric


@dataclass(frozen=True)
class ComparedFrame:
    """One camera's frame, stored for the temporal metrics of the next: pictures and their FLIP and LPIPS features.

    Each pair is of truth and rendering; None without LPIPS. Only the pixels of ``mask`` count.
    """

    truth: Picture
    picture: Picture
    flip: tuple[FlipFeatures, FlipFeatures]
    lpips: tuple[Features, Features] | None
    mask: Mask | None = None


def load_optional_metrics(
    cameras: Iterable[tuple[str, Camera]], *, frames: int, device: torch.device, lpips_weights: Path | None = None
) -> OptionalMetrics:
    """The metrics that are available here for these cameras (by name) and this number of frames: pictures must be large
    enough, and temporal metrics need two frames. Raises ConfigError if a file of weights is invalid, MissingExtraError
    without OpenCV."""
    missing: dict[str, str] = {}
    sides = {name: min(camera.width, camera.height) for name, camera in cameras}
    found: dict[str, Lpips] = {}
    weights: dict[str, str] = {}
    for trunk in TRUNKS:
        names = ("lpips_alex", "t_lpips") if trunk is ALEX else ("lpips_vgg",)
        path = weights_file(trunk, lpips_weights)
        if path is None:
            missing |= dict.fromkeys(names, how_to_get(trunk))
        else:
            found[trunk.name], weights[trunk.name] = load_lpips(trunk, path, device), path.name
            if reason := _too_small(sides, trunk.smallest):
                missing |= dict.fromkeys(names, reason)
    if reason := _too_small(sides, SMALLEST_OF_SCALES):
        missing["ms_ssim"] = reason
    if frames < 2:
        missing |= dict.fromkeys(TEMPORAL, "the stream has one frame, and this score compares two")
    return OptionalMetrics(dis_search("eval"), found, weights, missing)


def optional_scores(
    optional_metrics: OptionalMetrics,
    *,
    truth: Picture,
    picture: Picture,
    before: ComparedFrame | None,
    mask: Mask | None = None,
) -> tuple[dict[str, float | None], ComparedFrame]:
    """Further scores of one picture, by their names in ``Scores``, and the state for the next frame.

    FLIP, flicker and the warping error are computed over the pixels of ``mask``. MS-SSIM, LPIPS, temporal FLIP and
    tLPIPS compare whole pictures, so they are None with a mask.

    Args:
        before: the same camera's previous frame; None for the first.
        mask: ``[H, W]``, the pixels that count; None for all. Both pictures are black in the others.
    """
    alex, vgg = (None if mask is not None else _usable(optional_metrics, trunk.name, truth) for trunk in (ALEX, VGG))
    scores: dict[str, float | None] = {"ms_ssim": ms_ssim(picture, truth) if mask is None else None}
    flip = features_of(truth), features_of(picture)
    scores["flip"] = flip_of(*flip, mask=mask)
    features = None if alex is None else (alex.features(truth), alex.features(picture))
    scores["lpips_alex"] = None if alex is None or features is None else alex.distance(*features)
    scores["lpips_vgg"] = None if vgg is None else vgg.distance(vgg.features(truth), vgg.features(picture))
    if before is not None:
        counting = both(mask, before.mask)
        still = ~changed_pixels(truth, before.truth, counting)
        still = still if counting is None else still & counting
        scores["flicker"] = flicker(picture, before.picture, still)
        scores["truth_flicker"] = flicker(truth, before.truth, still)
        backward = optional_metrics.search(truth, before.truth)
        seen = consistency_mask(backward, optional_metrics.search(before.truth, truth))
        if mask is not None:
            seen &= mask
        if before.mask is not None:  # Only sources that counted in the frame before.
            seen &= sampled(before.mask.astype(np.float32)[..., None], backward)[..., 0] > 0.999
        scores["e_warp"] = warping_error(picture, before.picture, backward, seen)
        if counting is None:
            true, rendered = (flip_of(*pair) for pair in zip(flip, before.flip, strict=True))
            scores["temporal_flip"] = abs(rendered - true)
        if alex is not None and features is not None and before.lpips is not None:
            true, rendered = (alex.distance(*pair) for pair in zip(features, before.lpips, strict=True))
            scores["t_lpips"] = abs(rendered - true)  # tLP of Chu et al., 2020
    return scores, ComparedFrame(truth, picture, flip, features, mask)


def _usable(optional_metrics: OptionalMetrics, name: str, picture: Picture) -> Lpips | None:
    lpips = optional_metrics.lpips.get(name)
    return None if lpips is None or min(picture.shape[:2]) < lpips.trunk.smallest else lpips


def _too_small(sides: Mapping[str, int], smallest: int) -> str | None:
    small = [f"{name} ({side})" for name, side in sides.items() if side < smallest]
    return f"pictures need {smallest} pixels a side, fewer are those of {', '.join(small)}" if small else None
