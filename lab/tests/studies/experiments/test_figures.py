# SPDX-License-Identifier: Apache-2.0
"""Pictures are written, show what they should in colour, and details lie where the pictures differ most."""

from pathlib import Path

import numpy as np
import pytest

from outcomes import outcome
from structgstream.figure import COLORS, OTHER
from structgstream_studies.experiments.figures import (
    most_varied_crop,
    write_adjacent,
    write_comparison,
    write_curves,
    write_details,
)
from structgstream_studies.experiments.results import Result
from tests.support.drawn import coloured, pixels_of


def runs(*, e_warp: bool = False) -> list[Result]:
    """Two variants of three seeds over four frames."""
    found = []
    for number, key in enumerate(("without-free", "full")):
        for seed in range(3):
            frames = [
                {"psnr": 30 + number + seed / 10 - i / 5} | ({"e_warp": 0.001 * i} if e_warp and i else {})
                for i in range(4)
            ]
            cost = {"online_bytes": 10.0 ** (4 + number), "online_cpu_seconds": 2.0 + number}
            found.append(outcome(key, seed, psnr=30.0 + number + seed / 10, frames=frames, mean=cost))
    return found


TITLES = {"without-free": "w/o free 3DGs", "full": "full method", "held": "frame 0 held"}


def test_curves_have_a_line_for_each_variant_that_was_run(tmp_path: Path) -> None:
    write_curves(tmp_path / "new" / "c.png", runs(), keys=list(TITLES), titles=TITLES)
    picture = pixels_of(tmp_path / "new" / "c.png")
    assert coloured(picture, COLORS[0]) > 100
    assert coloured(picture, COLORS[1]) == coloured(picture, COLORS[2]) == 0
    held = [outcome("held", frames=[{"psnr": 29.0 - i} for i in range(4)])]
    write_curves(tmp_path / "more.png", [*runs(), *held], keys=list(TITLES), titles=TITLES)
    assert coloured(pixels_of(tmp_path / "more.png"), COLORS[2]) > 100


def test_a_score_that_nobody_has_gets_no_panel(tmp_path: Path) -> None:
    write_curves(tmp_path / "one.png", runs(), keys=list(TITLES), titles=TITLES)
    write_curves(tmp_path / "two.png", runs(e_warp=True), keys=list(TITLES), titles=TITLES)
    one, two = (pixels_of(tmp_path / f"{name}.png").shape[0] for name in ("one", "two"))
    assert two == pytest.approx(one * (2 * 2.4 + 0.4) / (2.4 + 0.4), abs=2)


def test_methods_are_points_with_the_spread_as_bars(tmp_path: Path) -> None:
    write_comparison(tmp_path / "m.png", runs(), titles=TITLES)
    picture = pixels_of(tmp_path / "m.png")
    assert coloured(picture, COLORS[0]) > 30
    left, right = np.split(picture, [picture.shape[1] // 2], axis=1)
    assert min(coloured(half, COLORS[0]) for half in (left, right)) > 15


def test_cited_methods_are_hollow_marks_in_both_panels(tmp_path: Path) -> None:
    write_comparison(tmp_path / "m.png", runs(), titles=TITLES)
    picture = pixels_of(tmp_path / "m.png")
    third = picture.shape[1] // 3  # the legend is in the last one
    assert all(coloured(picture[:, part], OTHER) > 10 for part in (slice(third), slice(third, 2 * third)))


def test_a_method_without_a_cost_is_left_out_and_no_cost_is_drawn_at_the_edge(tmp_path: Path) -> None:
    counts = []
    for seconds in (None, 2.0):
        free = [outcome("held", psnr=20.0, mean={"online_bytes": 0.0, "online_cpu_seconds": seconds})]
        write_comparison(tmp_path / "m.png", [*runs(), *free], titles=TITLES)
        picture = pixels_of(tmp_path / "m.png")
        assert coloured(picture[:, : picture.shape[1] // 4], COLORS[2]) > 10, "at the left of the first panel"
        counts.append(coloured(picture, COLORS[2]))
    assert counts[0] < counts[1] - 10, "a point in the second panel is there only with seconds"


def test_details_show_where_pictures_differ_most_and_nothing_else(tmp_path: Path) -> None:
    grey = np.full((80, 120, 3), 90, np.uint8)
    truth = grey.copy()
    truth[50:60, 80:95] = (250, 10, 20)
    rendering = grey.copy()
    rendering[50:60, 80:95] = (20, 240, 30)
    rendering[:10, :10] = (0, 0, 255)
    write_details(tmp_path / "d.png", {"ours": rendering}, truth, title="ring, camera a, frame 3")
    picture = pixels_of(tmp_path / "d.png")
    assert coloured(picture, "#fa0a14") > 1000
    assert coloured(picture, "#14f01e") > 1000
    assert coloured(picture, "#0000ff") == 0
    left, right = np.split(picture, [picture.shape[1] // 2], axis=1)
    assert coloured(left, "#fa0a14") == coloured(right, "#14f01e") == 0


def test_five_pictures_stand_in_two_rows(tmp_path: Path) -> None:
    pictures = {name: np.full((40, 40, 3), 60 + 20 * i, np.uint8) for i, name in enumerate("abcde")}
    write_details(tmp_path / "d.png", pictures, pictures["a"], title="t")
    picture = pixels_of(tmp_path / "d.png")
    grey = [coloured(picture, f"#{60 + 20 * i:02x}{60 + 20 * i:02x}{60 + 20 * i:02x}") for i in range(5)]
    assert min(grey) > 5000
    assert picture.shape[0] > picture.shape[1] // 3


def test_adjacent_pictures_show_where_a_method_changes_and_the_camera_saw_nothing_change(tmp_path: Path) -> None:
    still = np.full((64, 64, 3), 90, np.uint8)
    moved = still.copy()
    moved[:16, :16] = (10, 20, 250)  # the camera saw it, too
    flickering = moved.copy()
    flickering[40:52, 40:52, 0] = 110
    write_adjacent(
        tmp_path / "a.png", {"ours": [still, flickering, moved]}, [still, moved, moved], title="ring, camera a"
    )
    picture = pixels_of(tmp_path / "a.png")
    ours, truth = np.split(picture, [picture.shape[0] // 2])
    assert coloured(ours, "#6e5a5a") > 1000
    assert coloured(ours, "#a00000") > 1000  # 20 levels, 8 times
    assert coloured(truth, "#a00000") == coloured(picture, "#0a14fa") == 0


@pytest.mark.parametrize(("top", "left"), [(0, 0), (7, 20), (30, 60), (13, 1)])
def test_the_detail_with_the_most_of_a_mask(top: int, left: int) -> None:
    mask = np.zeros((40, 80), np.int64)
    mask[top : top + 10, left : left + 20] = 1
    assert most_varied_crop(mask) == (top, left, 10, 20)


def test_the_larger_of_two_spots_is_shown() -> None:
    mask = np.zeros((40, 80), np.int64)
    mask[2:5, 3:6] = 1
    mask[30:34, 70:74] = 1
    top, left, height, width = most_varied_crop(mask)
    assert mask[top : top + height, left : left + width].sum() == 16
    mask[28:36, 10:16] = 1
    assert (most_varied_crop(mask)[0], most_varied_crop(mask)[1]) == (26, 0)
    assert most_varied_crop(np.zeros((41, 83), np.int64)) == (0, 0, 10, 20)
