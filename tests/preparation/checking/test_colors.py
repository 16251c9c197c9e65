# SPDX-License-Identifier: Apache-2.0
"""Cameras that film the same coloured patches with gains that are known, in linear light."""

from itertools import combinations

import numpy as np
import pytest

from structgstream.frames import MultiViewFrame
from structgstream.pose_check.check import Finding
from structgstream.pose_check.tracks import Evidence
from structgstream.preparation.checking.colors import Color, color_findings, compare_colors, exposure_findings

SIDE, ACROSS = 9, 12
PATCHES = ACROSS * ACROSS
CENTERS = np.stack(np.divmod(np.arange(PATCHES), ACROSS)[::-1], 1) * SIDE + SIDE / 2


def encoded(light: np.ndarray) -> np.ndarray:
    """sRGB of linear light (IEC 61966-2-1), 8 bits."""
    light = light.clip(0, 1)
    return (255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)).round()


def evidence_of(stops: dict[str, tuple[float, float, float]], *, wrong: float = 0.0, seed: int = 0) -> Evidence:
    """Each camera has each patch, of red, green and blue light by its gains; a share of its patches is of others."""
    generator = np.random.default_rng(seed)
    light = generator.uniform(0.03, 0.25, (PATCHES, 3))
    images = {}
    for name, gains in stops.items():
        filmed = light.copy()
        bad = generator.random(PATCHES) < wrong
        filmed[bad] = generator.uniform(0.01, 0.9, (int(bad.sum()), 3))
        tiles = encoded(filmed * 2.0 ** np.array(gains)).astype(np.uint8).reshape(ACROSS, ACROSS, 3)
        images[name] = tiles.repeat(SIDE, 0).repeat(SIDE, 1)
    rows = np.repeat(np.arange(PATCHES)[:, None], 2, 1)
    return Evidence(images, dict.fromkeys(stops, CENTERS), dict.fromkeys(combinations(stops, 2), rows))


STOPS = {"a": (0.0, 0.0, 0.0), "b": (0.0, 0.0, 0.0), "c": (-0.7, -0.7, -0.7), "d": (0.4, 0.0, -0.3), "e": (0.0,) * 3}


@pytest.mark.parametrize("wrong", [0.0, 0.15])
def test_gains_are_found_though_matches_are_wrong(wrong: float) -> None:
    found = compare_colors(evidence_of(STOPS, wrong=wrong))
    for name, (red, green, blue) in STOPS.items():
        color = found[name]
        # Eight bits at 1 % of light are 0.05 stops; medians are much better.
        assert color.exposure_stops == pytest.approx(green, abs=0.04)
        assert color.red_stops == pytest.approx(red - green, abs=0.04)
        assert color.blue_stops == pytest.approx(blue - green, abs=0.04)


def test_clipped_patches_are_not_compared() -> None:
    """Four stops brighter all is white or nearly, and says nothing."""
    assert "c" not in compare_colors(evidence_of({**STOPS, "c": (4.0, 4.0, 4.0)}))


def test_findings_name_the_cameras_with_their_stops() -> None:
    colors = compare_colors(evidence_of(STOPS))
    exposure, balance = color_findings(colors)
    assert (exposure.cameras, balance.cameras) == (("c",), ("d",))
    assert "'c' -0.7" in exposure.sentence
    assert "'d' +0.4" in balance.sentence
    assert {exposure.severity, balance.severity} == {"warning"}
    assert color_findings({name: color for name, color in colors.items() if name in "abe"}) == []


def test_the_worst_of_many_are_reported_first() -> None:
    colors = {f"cam{number}": Color(0.5 + 0.1 * number, 0.0, 0.0) for number in range(8)}
    (found,) = color_findings(colors)
    assert "'cam7' +1.20, 'cam6' +1.10" in found.sentence
    assert "and 2 more" in found.sentence
    assert len(found.cameras) == 8


def test_exposure_that_changes_during_the_take_is_named() -> None:
    """Not light that changes for all, nor what moves: other patches are lighter and darker by other amounts."""
    before = MultiViewFrame(0, 0.0, evidence_of(dict.fromkeys("abcd", (0.0, 0.0, 0.0))).images)

    def found(stops: dict[str, float], *, wrong: float = 0.0) -> list[Finding]:
        gains = {name: (own, own, own) for name in "abcd" for own in [stops.get(name, 0.0)]}
        return exposure_findings(before, MultiViewFrame(9, 0.3, evidence_of(gains, wrong=wrong).images))

    (finding,) = found({"c": -0.7})
    assert (finding.severity, finding.cameras) == ("warning", ("c",))
    assert "between frame 0 and frame 9, in stops against the other cameras: 'c' -0.7" in finding.sentence
    assert [finding.cameras for finding in found({"b": 0.5}, wrong=0.3)] == [("b",)]
    assert found(dict.fromkeys("abcd", -0.7)) == []
    moved = {**before.images, "c": before.images["c"][::-1]}
    assert exposure_findings(before, MultiViewFrame(9, 0.3, moved)) == []


def test_without_matches_nothing_is_compared() -> None:
    evidence = evidence_of(STOPS)
    nothing = {pair: np.empty((0, 2), np.intp) for pair in evidence.matches}
    assert compare_colors(Evidence(evidence.images, evidence.keypoints, nothing)) == {}
