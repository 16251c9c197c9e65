# SPDX-License-Identifier: Apache-2.0
"""Which frames and windows are the worst."""

import re
from dataclasses import replace

import numpy as np
import pytest

from structgstream.evaluation.evaluate import Compared
from structgstream.evaluation.ghosts import Ghosts
from structgstream.evaluation.pictures import side_by_side
from structgstream.evaluation.report import Scores
from structgstream.evaluation.worst import WorstPictures, badness, worst_window

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
    assert found is not None
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
