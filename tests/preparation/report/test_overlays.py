# SPDX-License-Identifier: Apache-2.0
"""What the pictures of a report show, read from the figures."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from matplotlib.lines import AxLine

from structgstream.pose_check.tracks import pair_errors
from structgstream.preparation import report as overlays
from structgstream.preparation.checking.check import Checked, check_capture
from tests.support.evidence_made import turned
from tests.support.memory_captures import MemoryCapture
from tests.support.planes import room_frame, room_rig

OFF = "cam03"


@pytest.fixture(scope="module")
def checked() -> Checked:
    """A room of seven cameras, of which one is stated with another pose than it has."""
    rig = room_rig(7)
    stated = rig.mapped({name: turned(camera, 2.0) if name == OFF else camera for name, camera in rig.cameras.items()})
    return check_capture(MemoryCapture(stated, [room_frame(rig)]))


def test_pairs_are_the_worst_of_who_is_off_then_the_worst_and_the_surest(checked: Checked) -> None:
    examined = checked.examination
    errors = pair_errors(examined.evidence, examined.cameras)
    pairs = overlays.chosen_pairs(examined)
    assert len(set(pairs)) == len(pairs) == overlays.MAX_PAIRS
    assert pairs[0] == max((pair for pair in errors if OFF in pair), key=lambda pair: errors[pair].pixels)
    assert max(errors, key=lambda pair: errors[pair].pixels) in pairs[:2]
    assert max(errors, key=lambda pair: errors[pair].matches) in pairs


def lines_and_marks(axis: Any) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Two points of each coloured line, and places of the marks, in the order of drawing."""
    drawn = [line for line in axis.lines if isinstance(line, AxLine)]
    lines = [(np.array(line.get_xy1()), np.array(line.get_xy2())) for line in drawn][1::2]  # a white one is under each
    marks = [line.get_xydata()[0] for line in axis.lines if line.get_marker() == "o"]
    return lines, np.array(marks)


def distances(lines: list[tuple[np.ndarray, np.ndarray]], marks: np.ndarray) -> list[float]:
    found = []
    for (start, end), mark in zip(lines, marks, strict=True):
        along, away = end - start, mark - start
        found.append(float(abs(along[0] * away[1] - along[1] * away[0]) / np.linalg.norm(along)))
    return found


def test_lines_run_through_their_points(drawn: Callable[..., Any], checked: Checked) -> None:
    examined = checked.examination
    for pair, low, high in ((("cam01", "cam02"), 0.0, 1.5), (("cam02", OFF), 1.5, 20.0)):
        left, right = drawn(overlays.draw_epipolar, examined, pair).axes
        lines, marks = lines_and_marks(right)
        assert len(lines) == len(marks) == len(left.lines) == overlays.LINES
        assert low < np.median(distances(lines, marks)) < high
        first = {tuple(line.get_xydata()[0]) for line in left.lines}
        assert first <= {tuple(pixel) for pixel in examined.evidence.pixels(pair)[0]}
        assert len(first) == overlays.LINES
        spread = np.array(sorted(first))
        apart = np.linalg.norm(spread[:, None] - spread[None], axis=2) + 1e9 * np.eye(len(spread))
        assert apart.min() > 15  # far from each other


def test_keypoints_are_coloured_by_their_error_and_the_title_says_who_is_off(
    drawn: Callable[..., Any], checked: Checked
) -> None:
    examined, report = checked.examination, checked.report
    for name in ("cam01", OFF):
        axis = drawn(overlays.draw_overlay, examined, report, name).axes[0]
        (points,) = axis.collections
        tracks = examined.tracks
        own = tracks.of(name) & np.isfinite(tracks.residuals)
        assert {tuple(pixel) for pixel in points.get_offsets()} == {tuple(pixel) for pixel in tracks.pixels[own]}
        assert points.get_array().max() <= 2 * examined.suspects.limit_pixels
        title = axis.get_title(loc="left")
        assert title.startswith(f"{name} - OFF" if name == OFF else f"{name}:")
        assert f"{report.cameras[name].reprojection_pixels:.2f} px" in title
