# SPDX-License-Identifier: Apache-2.0
"""Means, slopes, the documented keys, and what stands in the panels over time."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from structgstream.evaluation import plots
from structgstream.evaluation.report import (
    FrameScores,
    Report,
    Scores,
    as_json,
    drawing_facts,
    mean_scores,
    psnr_trend,
    slope,
    slope_at_equal_shares,
    write_json,
)
from tests.support.reports import frame_scores, report_of

GOOD = Scores(30.0, 0.9, 31.0, None, 30.0, 0.0, 0.1)


def small_report() -> Report:
    frames = [
        frame_scores(
            index,
            {
                "left": replace(GOOD, psnr=30.0 - index, psnr_changed=20.0 if index else None),
                "right": replace(GOOD, psnr=28.0 - index, psnr_changed=24.0 if index else None),
            },
            field_bytes={"anchor_positions": 800, "free": 100 * index},
            log={"index": index, "seconds": {"render": 1.0}, "total_seconds": 2.0, "peak_memory_bytes": 5},
        )
        for index in range(4)
    ]
    return report_of(frames, **psnr_trend(frames), **drawing_facts(frames), total_bytes=5000)


def test_means_skip_what_is_not_there() -> None:
    mean = mean_scores([GOOD, replace(GOOD, psnr=32.0, psnr_changed=20.0)])
    assert (mean.psnr, mean.psnr_changed) == (31.0, 20.0)
    assert mean_scores([GOOD]).psnr_changed is None


def test_the_course_of_psnr() -> None:
    facts = psnr_trend(small_report().frames)
    assert (facts["psnr_first"], facts["psnr_last"], facts["psnr_worst"]) == (29.0, 26.0, 26.0)
    assert facts["drop_from_first_db"] == 3.0
    assert slope([30.0, 29.0, 28.0]) == pytest.approx(-1.0)
    assert slope([30.0]) == 0.0


def course(*frames: dict[str, Scores]) -> list[FrameScores]:
    return [frame_scores(n, cameras) for n, cameras in enumerate(frames)]


def mixed(share: float, changed: float = 20.0, still: float = 40.0) -> Scores:
    """Scores of a picture of which ``share`` has changed."""
    psnr = -10.0 * math.log10(share * 10.0 ** (-changed / 10.0) + (1.0 - share) * 10.0 ** (-still / 10.0))
    return replace(GOOD, psnr=psnr, psnr_changed=changed, psnr_still=still, changed_share=share)


def test_more_that_moves_is_no_drift_at_equal_shares() -> None:
    frames = course({"left": GOOD}, *({"left": mixed(0.1 * n)} for n in range(1, 5)))
    assert slope([frame.mean.psnr for frame in frames if frame.mean]) < -1.0
    assert slope_at_equal_shares(frames) == pytest.approx(0.0, abs=1e-9)


def test_pixels_that_get_worse_are_drift_at_equal_shares() -> None:
    frames = course(*({"left": mixed(0.1 * n, 20.0 - n, 40.0 - n), "right": GOOD} for n in range(1, 5)))
    assert slope_at_equal_shares(frames) == pytest.approx(-1.0)
    assert slope_at_equal_shares(frames[:1]) is None


def test_an_equal_share_is_each_camera_s_own() -> None:
    """A camera that sees more motion keeps seeing more; one that is absent from a frame is not there in it."""
    both = {"left": mixed(0.1), "right": mixed(0.5, 30.0)}
    assert slope_at_equal_shares(course(both, both)) == pytest.approx(0.0, abs=1e-9)
    gone = slope_at_equal_shares(course(both, {"left": mixed(0.1)}))
    assert gone == pytest.approx((both["left"].psnr - both["right"].psnr) / 2)


def test_pictures_a_second_with_and_without_the_decoding() -> None:
    facts = drawing_facts(small_report().frames)
    assert facts["render_fps"] == pytest.approx(10.0)
    assert facts["decode_and_render_fps"] == pytest.approx(5.0)


def test_json_has_the_documented_keys(tmp_path: Path) -> None:
    write_json(tmp_path / "deep" / "report.json", as_json(small_report()))
    content = json.loads((tmp_path / "deep" / "report.json").read_text())
    assert set(content) == {"mean", "cameras", "stream", "environment", "frames"}
    scores = {field.name for field in fields(Scores)}
    assert {"psnr", "psnr_camera_color", "ms_ssim", "flip", "lpips_vgg", "e_warp", "flicker"} < scores
    assert set(content["mean"]) == scores | {"bytes", "bytes_with_header", "free", "seconds"}
    assert content["mean"]["psnr"] == pytest.approx(27.5)
    assert content["mean"]["psnr_changed"] == pytest.approx(22.0)
    assert content["mean"]["bytes"] == 1000
    assert content["mean"]["bytes_with_header"] == 1250
    assert content["mean"]["seconds"] == 2.0
    assert len(content["frames"]) == 4
    assert set(content["frames"][0]) == scores | {
        "index", "pts_seconds", "kind", "bytes", "field_bytes", "anchors", "free", "decode_seconds",
        "cameras", "log",
    }  # fmt: skip
    assert content["frames"][0]["psnr_changed"] is None
    assert set(content["cameras"]["left"]) == scores
    assert content["stream"]["drift_db_per_frame"] == pytest.approx(-1.0)


def test_scores_of_disoccluded_pixels_are_weighed_by_their_number() -> None:
    many = replace(GOOD, disoccluded_share=0.3, ghost_share=0.1, psnr_disoccluded=30.0)
    few = replace(GOOD, disoccluded_share=0.1, ghost_share=0.5, psnr_disoccluded=20.0)
    none = replace(GOOD, disoccluded_share=0.0)
    mean = mean_scores([many, few, none])
    assert (mean.ghost_share, mean.psnr_disoccluded) == (pytest.approx(0.2), pytest.approx(27.5))
    assert mean.disoccluded_share == pytest.approx(0.4 / 3)
    assert mean_scores([none, GOOD]).ghost_share is None


def frame(index: int, psnrs: dict[str, float], *, log: dict[str, Any] | None = None, **sizes: int) -> FrameScores:
    cameras = {name: Scores(psnr, 0.9, psnr, None, None, 0.0, 0.1) for name, psnr in psnrs.items()}
    return frame_scores(index, cameras, field_bytes=sizes or {"free": 1000}, anchors=40 + index, log=log or {})


def panels(frames: list[FrameScores], monkeypatch: pytest.MonkeyPatch) -> dict[str, Axes]:
    """The axes of the figure by what they show."""
    figures: list[Figure] = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, path: figures.append(figure))
    plots.write_plots(Path("unused.png"), report_of(frames), title="a result")
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
