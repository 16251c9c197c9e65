# SPDX-License-Identifier: Apache-2.0
"""What stands in the panels over time: the numbers themselves, read from the figure before it becomes a picture."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from structgstream.evaluation import plots
from structgstream.evaluation.report import FrameScores, Report, Scores, mean_scores
from tests.support.reports import mean_of


def frame(index: int, psnrs: dict[str, float], *, log: dict[str, Any] | None = None, **sizes: int) -> FrameScores:
    cameras = {name: Scores(psnr, 0.9, psnr, None, None, 0.0, 0.1) for name, psnr in psnrs.items()}
    return FrameScores(
        index=index,
        pts_seconds=index / 30,
        kind="delta" if index else "key",
        bytes=1000,
        field_bytes=sizes or {"free": 1000},
        anchors=40 + index,
        free=index,
        decode_seconds=0.1,
        cameras=cameras,
        mean=mean_scores(cameras.values()),
        log=log or {},
    )


def panels(frames: list[FrameScores], monkeypatch: pytest.MonkeyPatch) -> dict[str, Axes]:
    """The axes of the figure by what they show."""
    figures: list[Figure] = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, path: figures.append(figure))
    names = [*frames[0].cameras]
    by_camera = {name: mean_scores(one.cameras[name] for one in frames) for name in names}
    report = Report(frames, by_camera, mean_scores(mean_of(one) for one in frames), {}, {})
    plots.write_plots(Path("unused.png"), report, title="a result")
    return {axis.get_ylabel(): axis for axis in figures[0].axes}


def lines(axis: Axes) -> dict[str, list[float]]:
    return {str(line.get_label()): [float(y) for y in np.asarray(line.get_ydata())] for line in axis.get_lines()}


def heights(axis: Axes) -> dict[str, list[float]]:
    return {
        str(bars.get_label()): [round(bar.get_height(), 6) for bar in bars]  # type: ignore[attr-defined]
        for bars in axis.containers
    }


def test_ghosts_have_a_panel_where_there_is_a_place_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    two = [frame(0, {"left": 30.0}), frame(1, {"left": 29.0})]
    name = "ghosts, % of disoccluded"
    assert name not in panels(two, monkeypatch)
    scores = replace(two[1].cameras["left"], ghost_share=0.25, disoccluded_share=0.1, psnr_half=33.0)
    shown = panels([two[0], replace(two[1], cameras={"left": scores}, mean=scores)], monkeypatch)
    assert lines(shown[name]) == {"camera left": [25.0], "all": [25.0]}
    assert lines(shown["PSNR, dB"])["half size"] == [33.0]


def test_quality_by_camera_and_their_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    two = [frame(0, {"left": 30.0, "right": 26.0}), frame(1, {"left": 29.0, "right": 25.0})]
    shown = panels(two, monkeypatch)
    assert lines(shown["PSNR, dB"]) == {"camera left": [30, 29], "camera right": [26, 25], "mean": [28, 27]}
    assert lines(shown["count"]) == {"anchors": [40, 41], "free Gaussians": [0, 1]}
    assert "seconds" not in shown, "there is no log"
    assert "mean" not in lines(panels([frame(0, {"left": 30.0})], monkeypatch)["PSNR, dB"])


def test_bytes_stand_on_each_other_the_largest_field_lowest(monkeypatch: pytest.MonkeyPatch) -> None:
    """A field below a thousandth of the whole is left out."""
    frames = [frame(i, {"left": 30.0}, free=1000 * i, anchor_positions=4000, offset_scales=2) for i in range(3)]
    axis = panels(frames, monkeypatch)["kB"]
    assert heights(axis) == {"anchor positions": [4, 4, 4], "free": [0, 1, 2]}
    assert [bar.get_y() for bar in axis.containers[1]] == [4, 4, 4]  # type: ignore[attr-defined]


def test_seconds_add_up_to_the_total_and_a_long_first_frame_is_written_out(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [
        frame(0, {"left": 30.0}, log={"seconds": {"render": 60.0, "fit": 70.0, "total": 90.0}}),
        frame(1, {"left": 30.0}, log={"seconds": {"render": 2.0, "loss": 1.0, "fit": 3.0, "total": 3.5}}),
    ]
    axis = panels(frames, monkeypatch)["seconds"]
    assert heights(axis) == {"render": [60, 2], "other": [30, 0.5], "loss": [0, 1]}
    assert axis.get_ylim()[1] == pytest.approx(1.3 * 3.5)
    assert [note.get_text() for note in axis.texts] == ["first frame: 90 s"]


def test_no_two_stages_look_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run on a CPU has ten stages, which is more than there are colours."""
    seconds = {f"stage {number}": float(number) for number in range(1, 13)}
    axis = panels([frame(0, {"left": 30.0}, log={"seconds": seconds | {"total": 78.0}})], monkeypatch)["seconds"]
    looks = {(bars[0].get_facecolor(), bars[0].get_hatch()) for bars in axis.containers}  # type: ignore[index]
    assert len(looks) == len(axis.containers) == 12
