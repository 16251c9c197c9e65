# SPDX-License-Identifier: Apache-2.0
"""Comparisons have the pixels they claim; the worst frames and windows, and the page that shows them."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from structgstream.evaluation.evaluate import Compared
from structgstream.evaluation.ghosts import Ghosts
from structgstream.evaluation.pictures import (
    LARGEST_TILE,
    contact_sheet,
    difference,
    side_by_side,
    spread_indices,
    thumbnail,
)
from structgstream.evaluation.report import Scores
from structgstream.evaluation.worst import Crop, WorstPictures, badness, worst_window, write_page
from tests.support.drawn import pixels_of


def test_difference_is_four_times_the_error_and_clamped() -> None:
    picture = np.array([[[10, 200, 0]]], np.uint8)
    truth = np.array([[[20, 100, 0]]], np.uint8)
    assert difference(picture, truth).ravel().tolist() == [40, 255, 0]


def test_side_by_side_is_truth_rendering_difference() -> None:
    truth, picture = np.full((5, 6, 3), 100, np.uint8), np.full((5, 6, 3), 110, np.uint8)
    row = side_by_side(truth, picture)[2, :, 0].tolist()
    assert row == [100] * 6 + [255] * 4 + [110] * 6 + [255] * 4 + [40] * 6


def test_thumbnails_are_as_wide_as_a_tile_at_most() -> None:
    """What their pixels are: test_metrics.py."""
    small = thumbnail(np.zeros((6, 2 * LARGEST_TILE, 3), np.uint8))
    assert small.shape == (3, LARGEST_TILE, 3)
    assert thumbnail(small).shape == small.shape


def test_sampled_frames_hold_the_first_and_the_last() -> None:
    assert spread_indices(12, 4) == [0, 4, 7, 11]
    assert spread_indices(2, 5) == [0, 1]
    assert spread_indices(1, 5) == [0]


def test_a_contact_sheet_shows_every_picture_pixel_for_pixel(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    cells = {
        name: {i: tuple(rng.integers(0, 256, (30, 40, 3)).astype(np.uint8) for _ in range(2)) for i in (0, 3)}
        for name in ("a", "b")
    }
    contact_sheet(tmp_path / "sheet.png", cells, title="a result")  # pyright: ignore[reportArgumentType]
    sheet = pixels_of(tmp_path / "sheet.png")
    for pictures in cells.values():
        for pair in pictures.values():
            for picture in pair:
                found = cv2.matchTemplate(sheet.copy(), picture, cv2.TM_SQDIFF).min()
                assert (
                    found < 100
                )  # the transform rounds at 1e-7 of sums near 1e8; one wrong level everywhere gives 3600


SCORES = Scores(30.0, 0.9, 31.0, 25.0, 32.0, 0.05, 0.1)


def compared(
    *, camera: str = "cam/0", at: tuple[int, int] = (50, 80), psnr: float = 25.0, ghost: bool = False
) -> Compared:
    """An error of 12x12 pixels, of a pixel that changed or of one where something was."""
    first = np.full((120, 160, 3), 90, np.uint8)
    truth, picture = first.copy(), first.copy()
    y, x = at
    picture[5:25, 5:25] = 200  # larger, but neither changed nor a ghost
    picture[y : y + 12, x : x + 12] = 180
    ghosts = np.zeros((60, 80), np.bool_)  # of a picture that was reduced
    scores = replace(SCORES, psnr_changed=psnr)
    if ghost:
        ghosts[y // 2 : y // 2 + 6, x // 2 : x // 2 + 6] = True
        scores = replace(SCORES, psnr_changed=None, disoccluded_share=0.1, ghost_share=0.2)
    else:
        truth[y : y + 12, x : x + 12] = 250
    return Compared(camera, truth, picture, scores, first, None, Ghosts(ghosts, ghosts, 4800, 2, 20.0))


@pytest.mark.parametrize("at", [(0, 0), (50, 80), (108, 148)])
@pytest.mark.parametrize("ghost", [False, True])
def test_the_window_holds_the_error_that_the_frame_was_chosen_by(at: tuple[int, int], ghost: bool) -> None:
    worst = WorstPictures()
    shown = compared(at=at, ghost=ghost)
    worst.see(4, shown)
    (crop,) = worst.crops()
    found = re.search(r"; 40x40 pixels at \((\d+), (\d+)\)$", crop.caption)
    (left, top), (y, x) = map(int, found.groups()), at
    assert (crop.frame, crop.camera, crop.reason) == (4, "cam/0", "ghosts" if ghost else "changed")
    why = "20.0% of the disoccluded pixels, which are 10.0% of the picture" if ghost else " dB on changed pixels"
    assert why in crop.caption
    assert left <= x <= x + 12 <= left + 40 <= 160
    assert top <= y <= y + 12 <= top + 40 <= 120
    window = np.s_[top : top + 40, left : left + 40]
    np.testing.assert_array_equal(crop.picture, side_by_side(shown.truth[window], shown.picture[window]))


def test_the_worst_three_frames_are_kept_each_with_its_worst_camera() -> None:
    worst = WorstPictures()
    psnrs = {0: 26.0, 1: 21.0, 2: 25.0, 3: 19.0, 4: 24.0}
    for index, psnr in psnrs.items():
        worst.see(index, compared(psnr=psnr))
        worst.see(index, compared(camera="b", psnr=psnr - 0.5 if index == 3 else 40.0))
    assert [(crop.frame, crop.camera) for crop in worst.crops()] == [(3, "b"), (1, "cam/0"), (4, "cam/0")]


def test_a_handful_of_changed_pixels_says_nothing() -> None:
    assert badness(replace(SCORES, changed_share=1e-4, psnr_changed=5.0), "changed") is None
    assert badness(SCORES, "ghosts") is None
    assert badness(replace(SCORES, ghost_share=0.0, disoccluded_share=0.1), "ghosts") is None


def test_small_pictures_have_a_window_of_one_pixel() -> None:
    assert worst_window(np.array([[1, 5], [2, 0]], np.int64)) == (slice(0, 1), slice(1, 2))
    assert worst_window(np.zeros((1, 1), np.int64)) == (slice(0, 1), slice(0, 1))


def test_every_crop_is_on_the_page_with_its_reason(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    pictures = [random.integers(0, 256, (20, 68, 3)).astype(np.uint8) for _ in range(2)]
    crops = [
        Crop("changed", 2, "cam/0", "camera <0>: 20.00 dB", pictures[0]),
        Crop("ghosts", 3, "cam/0", "20.0% of the picture", pictures[1]),
    ]
    write_page(tmp_path, crops, title="a <title>", pictures=["over_time.png"])
    page = (tmp_path / "index.html").read_text()
    assert "a &lt;title&gt;" in page
    assert "<figcaption>camera &lt;0&gt;: 20.00 dB</figcaption>" in page
    assert "20.0% of the picture" in page
    names = [f"worst/{name}-cam_0.png" for name in ("changed-000002", "ghosts-000003")]
    assert page.index(names[0]) < page.index(names[1]) < page.index("over_time.png")
    for name, picture in zip(names, pictures, strict=True):
        np.testing.assert_array_equal(pixels_of(tmp_path / name), picture)


def test_a_report_without_crops_has_a_page(tmp_path: Path) -> None:
    write_page(tmp_path, [], title="nothing moves", pictures=["over_time.png"])
    page = (tmp_path / "index.html").read_text()
    assert "over_time.png" in page
    assert "<h2>" not in page
