# SPDX-License-Identifier: Apache-2.0
"""The page, and what charts and pictures show, read from the figures."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.lines import AxLine

from structgstream.errors import StorageError
from structgstream.pose_check.tracks import pair_errors
from structgstream.preparation import report as charts
from structgstream.preparation.checking.check import (
    CameraCheck,
    Checked,
    CheckReport,
    Coverage,
    Examination,
    PairCheck,
    check_capture,
    examine,
)
from structgstream.preparation.report import write_report
from tests.support.drawn import pixels_of
from tests.support.evidence_made import turned
from tests.support.memory_captures import MemoryCapture
from tests.support.planes import room_frame, room_rig


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Calls a function that draws, and returns its figure."""

    def draw(function: Callable[..., None], *arguments: Any, **keywords: Any) -> Any:
        kept: list[Any] = []
        monkeypatch.setattr(charts, "save_figure", lambda figure, path: kept.append(figure))
        function(Path("unused.png"), *arguments, **keywords)
        (figure,) = kept
        return figure

    return draw


def test_the_page_shows_everything_and_loads_nothing(tmp_path: Path) -> None:
    rig = room_rig(5)
    checked = check_capture(MemoryCapture(rig, [room_frame(rig)], name="<room>"))
    report = replace(checked.report, steps={"scale": "metres"})
    page = write_report(tmp_path / "report", replace(checked, report=report)).read_text()
    assert "&lt;room&gt;" in page
    assert "http" not in page
    pictures = re.findall(r"<img src='([^']+)'", page)
    assert {f"camera_{number}.png" for number in range(5)} <= set(pictures)
    assert {"pairs.png", "coverage.png", "colors.png"} <= set(pictures)
    for name in pictures:
        assert pixels_of(tmp_path / "report" / name).std() > 5
    numbers = json.loads((tmp_path / "report" / "report.json").read_text())
    assert set(numbers["cameras"]) == set(rig)
    assert numbers["steps"] == {"scale": "metres"}
    assert numbers["median_epipolar_pixels"] == report.median_epipolar_pixels


def test_an_earlier_report_goes_and_nothing_of_anybody_else(tmp_path: Path) -> None:
    rig = room_rig(4)
    checked = check_capture(MemoryCapture(rig, [room_frame(rig, textured=False)]))
    write_report(tmp_path / "report", checked)
    for name in ("camera_9.png", "camera_front.png"):
        (tmp_path / "report" / name).write_text("")
    write_report(tmp_path / "report", checked)
    assert not (tmp_path / "report" / "camera_9.png").exists()
    assert (tmp_path / "report" / "camera_front.png").is_file()
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text("mine")
    for place in ("site", "site/index.html"):
        with pytest.raises(StorageError, match="report of a check"):
            write_report(tmp_path / place, checked)
    assert [path.name for path in (tmp_path / "site").iterdir()] == ["index.html"]
    assert (tmp_path / "site" / "index.html").read_text() == "mine"


def report_of(cameras: dict[str, CameraCheck], pairs: tuple[PairCheck, ...] = ()) -> CheckReport:
    return CheckReport("take", 0, cameras, pairs, Coverage(0, 0.0, 0.0), (), 1.0, 0.1, None)


def test_the_matrix_has_every_pair_on_both_sides_of_its_diagonal(drawn: Callable[..., Any]) -> None:
    plain = CameraCheck(None, None, 0, 0)
    pairs = (PairCheck("a", "b", 40, 0.5, 0.0), PairCheck("c", "b", 30, 7.25, 0.9), PairCheck("a", "c", 0, None, None))
    figure = drawn(charts.draw_matrix, report_of(dict.fromkeys("abc", plain), pairs), limit_pixels=2.0)
    axis = figure.axes[0]
    (shown,) = axis.images
    values = np.ma.filled(shown.get_array().astype(float), np.nan)
    nan = np.nan
    np.testing.assert_array_equal(values, [[nan, 0.5, nan], [0.5, nan, 7.25], [nan, 7.25, nan]])
    assert shown.get_clim() == (0, 4)
    texts = {(int(text.get_position()[0]), int(text.get_position()[1])): text.get_text() for text in axis.texts}
    assert texts == {(0, 1): "0.5", (1, 0): "0.5", (1, 2): "7.2", (2, 1): "7.2"}
    assert "x:" not in axis.get_title(loc="left")


@pytest.mark.parametrize("count", [3, 20])
def test_pairs_of_wrong_matches_have_a_cross(drawn: Callable[..., Any], count: int) -> None:
    names = [f"cam{number:02d}" for number in range(count)]
    report = report_of(
        dict.fromkeys(names, CameraCheck(None, None, 0, 0)),
        (PairCheck(names[0], names[1], 40, 0.5, 0.0), PairCheck(names[1], names[2], 21, 90.0, 0.9)),
    )
    axis = drawn(charts.draw_matrix, report, limit_pixels=2.0, stray=[(names[1], names[2])]).axes[0]
    crossed = {text.get_position() for text in axis.texts if "x" in text.get_text()}
    assert crossed == {(1, 2), (2, 1)}
    assert "wrong matches" in axis.get_title(loc="left")


def test_colours_are_bars_of_the_cameras_that_were_compared(drawn: Callable[..., Any]) -> None:
    cameras = {
        "a": CameraCheck(None, None, 0, 0, exposure_stops=-1.5, red_stops=0.1, blue_stops=0.2),
        "b": CameraCheck(None, None, 0, 0),
        "c": CameraCheck(None, None, 0, 0, exposure_stops=0.0, red_stops=-0.3, blue_stops=0.0),
    }
    axis = drawn(charts.draw_colors, report_of(cameras)).axes[0]
    heights = {bars.get_label(): [bar.get_height() for bar in bars] for bars in axis.containers}
    assert heights == {"exposure": [-1.5, 0.0], "red / green": [0.1, -0.3], "blue / green": [0.2, 0.0]}
    assert [label.get_text() for label in axis.get_xticklabels()] == ["a", "c"]
    low, high = axis.get_ylim()
    assert low < -1.5
    assert high == -low


def test_times_are_points_of_the_cameras_that_were_judged_and_all_bars_fit(drawn: Callable[..., Any]) -> None:
    late = {"a": 0.5, "b": -6.0, "c": 30.0}
    cameras = {
        name: CameraCheck(None, None, 0, 0, offset_ms=offset, offset_uncertainty_ms=2.0)
        for name, offset in late.items()
    } | {"d": CameraCheck(None, None, 0, 0)}
    axis = drawn(charts.draw_times, report_of(cameras)).axes[0]
    (points,) = axis.containers
    assert [list(row) for row in points.lines[0].get_data()] == [[0, 1, 2], [*late.values()]]
    low, high = axis.get_ylim()
    assert high > 34
    assert low == -high


@pytest.fixture(scope="module")
def examined() -> Examination:
    rig = room_rig(5)
    return examine(room_frame(rig), rig.cameras)


def test_the_rig_is_drawn_upright_and_in_its_proportions(drawn: Callable[..., Any], examined: Examination) -> None:
    """Cameras of the room stand at two heights that are 0.3 apart, on an arc of radius 2.5 over 0.8 radians."""
    above, side, _ = drawn(charts.draw_coverage, examined, near=0.1, unit="metres").axes
    places = []
    for axis in (above, side):
        squares = [line.get_xydata()[0] for line in axis.lines if line.get_marker() == "s"]
        assert len(squares) == 5
        places.append(np.array(squares))
    across, height = places[0][:, 0], places[1][:, 1]
    assert np.ptp(across) == pytest.approx(2 * 2.5 * np.sin(0.4), abs=0.02)
    np.testing.assert_allclose(np.diff(height), [0.3, -0.3, 0.3, -0.3], atol=1e-6)
    np.testing.assert_allclose(places[0][:, 1], places[1][:, 0], atol=1e-9)  # depth is in both
    ahead = np.median(examined.tracks.points[:, 2])
    assert 0.3 < ahead < 1.6  # the room lies in front of the cameras
    (points,) = above.collections
    assert np.median(np.asarray(points.get_offsets())[:, 1]) > places[0][:, 1].max()


def test_names_are_reported_once_each(drawn: Callable[..., Any], examined: Examination) -> None:
    above, side, _ = drawn(charts.draw_coverage, examined, near=0.1, unit="metres").axes
    reported = [name for text in above.texts for name in text.get_text().split("\n") if name]
    assert sorted(reported) == sorted(examined.cameras)
    assert not any(text.get_text() for text in side.texts)


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
    pairs = charts.chosen_pairs(examined)
    assert len(set(pairs)) == len(pairs) == charts.MAX_PAIRS
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
        left, right = drawn(charts.draw_epipolar, examined, pair).axes
        lines, marks = lines_and_marks(right)
        assert len(lines) == len(marks) == len(left.lines) == charts.LINES
        assert low < np.median(distances(lines, marks)) < high
        first = {tuple(line.get_xydata()[0]) for line in left.lines}
        assert first <= {tuple(pixel) for pixel in examined.evidence.pixels(pair)[0]}
        assert len(first) == charts.LINES
        spread = np.array(sorted(first))
        apart = np.linalg.norm(spread[:, None] - spread[None], axis=2) + 1e9 * np.eye(len(spread))
        assert apart.min() > 15  # far from each other


def test_keypoints_are_coloured_by_their_error_and_the_title_says_who_is_off(
    drawn: Callable[..., Any], checked: Checked
) -> None:
    examined, report = checked.examination, checked.report
    for name in ("cam01", OFF):
        axis = drawn(charts.draw_overlay, examined, report, name).axes[0]
        (points,) = axis.collections
        tracks = examined.tracks
        own = tracks.of(name) & np.isfinite(tracks.residuals)
        assert {tuple(pixel) for pixel in points.get_offsets()} == {tuple(pixel) for pixel in tracks.pixels[own]}
        assert points.get_array().max() <= 2 * examined.suspects.limit_pixels
        title = axis.get_title(loc="left")
        assert title.startswith(f"{name} - OFF" if name == OFF else f"{name}:")
        assert f"{report.cameras[name].reprojection_pixels:.2f} px" in title
