# SPDX-License-Identifier: Apache-2.0
"""Cross-validation of a comparison with other held-out cameras.

Note [Second fold]
~~~~~~~~~~~~~~~~~~
The held-out cameras of the second fold are chosen by their positions only, without pictures or results: among the
cameras that no other fold scores and that were not used for choices, the most evenly spread ones
(:func:`even_cameras`).
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import combinations

import torch

from structgstream.cameras import CameraRig
from structgstream.errors import ConfigError
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import SCORES, Sheet, format_score
from structgstream_studies.experiments.summary import Summary, summaries
from structgstream_studies.experiments.variants import FULL

_COLUMNS = (
    ("psnr_first", "psnr_first"),
    ("psnr", "psnr"),
    ("psnr_camera_color", "psnr_camera_color"),
    ("psnr_changed", "psnr_changed"),
    ("psnr_still", "psnr_still"),
    ("online_bytes", "online_kilobytes"),
)
"""Scores, and how each is written."""


def even_cameras(rig: CameraRig, count: int, *, besides: Collection[str]) -> tuple[str, ...]:
    """The ``count`` cameras that are spread most evenly over the rig, in its order, none of ``besides`` among them.

    Those with the least largest distance from any camera of the rig to the nearest of them; among equals, to a
    millionth, those with the least mean distance, then the first. All choices are tried: for rigs of tens of cameras.

    Raises:
        ConfigError: there are fewer cameras, or ``besides`` names one that is not there.
    """
    if unknown := [name for name in besides if name not in rig.cameras]:
        raise ConfigError(f"The rig has no camera {unknown[0]!r}; it has {', '.join(rig)}.")
    names = [name for name in rig if name not in besides]
    if not 0 < count <= len(names):
        raise ConfigError(f"{count} of {len(names)} cameras cannot be held out; ask for 1 to {len(names)}.")
    centers = torch.stack([rig[name].center for name in rig]).double()
    rows = [list(rig).index(name) for name in names]
    apart = torch.cdist(centers, centers[rows])  # every camera to every one that may be chosen

    def spread(chosen: tuple[int, ...]) -> tuple[float, float, tuple[int, ...]]:
        nearest = apart[:, list(chosen)].amin(1)
        return round(float(nearest.max()), 6), round(float(nearest.mean()), 6), chosen

    best = min(map(spread, combinations(range(len(names)), count)))
    return tuple(names[i] for i in best[2])


def folds_sheet(folds: Sequence[Iterable[Result]], *, titles: Mapping[str, str]) -> Sheet:
    """Every method that some fold has, with a row for each fold: dashes where it was not run.

    The last column is the difference to paper mode within the fold, seed by seed: what must not depend on the cameras.
    """
    found = [summaries(results) for results in folds]
    rows = []
    for key, title in titles.items():
        if any(key in fold for fold in found):
            rows += [[title, str(number), *_cells(fold, key)] for number, fold in enumerate(found, start=1)]
    heads = ["method", "fold", "held out", "seeds", *(SCORES[name].title for _, name in _COLUMNS)]
    return Sheet("Folds", [*heads, "to paper mode, dB"], rows)


def _cells(fold: Mapping[str, Summary], key: str) -> list[str]:
    summary, full = fold.get(key), fold.get(FULL)
    if summary is None:
        return ["-"] * (3 + len(_COLUMNS))
    scored = next(iter(summary.results.values())).identity["capture"]["scored"]
    difference = None if full is None or key == FULL else summary.difference(full, "psnr")
    cells = [format_score(summary.score(score), name) for score, name in _COLUMNS]
    return [", ".join(scored), str(len(summary.results)), *cells, format_score(difference, "psnr", signed=True)]
