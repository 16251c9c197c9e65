# SPDX-License-Identifier: Apache-2.0
"""The picture of rates: the curve in ink, methods as points in colours, in two panels."""

from pathlib import Path

import numpy as np

from outcomes import outcome
from structgstream.figure import COLORS, INK
from structgstream_studies.experiments.rate_figures import write_rates
from structgstream_studies.experiments.results import Result
from tests.support.drawn import coloured, pixels_of


def curve() -> list[Result]:
    keys = ("quality-m2", "quality-m1", "compact", "quality-p1", "quality-p2")
    mean = [{"online_bytes": 5e3 * 2.0**i, "psnr_changed": 25.0 + i} for i in range(5)]
    return [outcome(key, psnr=29.0 + i, mean=mean[i]) for i, key in enumerate(keys)]


def test_the_curve_and_the_points_that_there_are(tmp_path: Path) -> None:
    paper = outcome("full", psnr=30.0, mean={"online_bytes": 1.7e6, "psnr_changed": 26.0})
    write_rates(tmp_path / "new" / "with.png", [*curve(), paper])
    write_rates(tmp_path / "without.png", curve())
    both, alone = pixels_of(tmp_path / "new" / "with.png"), pixels_of(tmp_path / "without.png")
    for half in np.split(both, [both.shape[1] // 2], axis=1):
        assert coloured(half, COLORS[0]) > 20
        assert coloured(half, COLORS[1]) == 0
        assert coloured(half, INK) > 100
    assert coloured(alone, COLORS[0]) == 0
    assert coloured(alone, INK) > 200


def test_a_score_or_a_rate_that_nobody_has_leaves_its_panel_empty(tmp_path: Path) -> None:
    held = outcome("3dgstream", psnr=24.0, mean={"online_bytes": 0.0})
    without = [outcome("compact", psnr=30.0, mean={"online_bytes": 1e4}), held]
    write_rates(tmp_path / "r.png", without)
    picture = pixels_of(tmp_path / "r.png")
    left, right = np.split(picture, [picture.shape[1] // 2], axis=1)
    assert coloured(left, INK) > coloured(right, INK)
    assert coloured(picture, COLORS[1]) == 0
