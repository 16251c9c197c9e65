# SPDX-License-Identifier: Apache-2.0
"""Means, slopes, the documented keys, and the plot."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import pytest

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

GOOD = Scores(30.0, 0.9, 31.0, None, 30.0, 0.0, 0.1)


def small_report() -> Report:
    frames = []
    for index in range(4):
        cameras = {
            "left": replace(GOOD, psnr=30.0 - index, psnr_changed=20.0 if index else None),
            "right": replace(GOOD, psnr=28.0 - index, psnr_changed=24.0 if index else None),
        }
        frames.append(
            FrameScores(
                index=index,
                pts_seconds=index / 30,
                kind="delta" if index else "key",
                bytes=1000,
                field_bytes={"anchor_positions": 800, "free": 100 * index},
                anchors=50,
                free=index,
                decode_seconds=0.1,
                cameras=cameras,
                mean=mean_scores(cameras.values()),
                log={
                    "index": index,
                    "seconds": {"render": 1.0},
                    "total_seconds": 2.0,
                    "peak_memory_bytes": 5,
                },
            )
        )
    by_camera = {name: mean_scores(frame.cameras[name] for frame in frames) for name in ("left", "right")}
    facts = psnr_trend(frames) | drawing_facts(frames) | {"total_bytes": 5000}
    return Report(frames, by_camera, mean_scores(frame.mean for frame in frames), facts, {"python": "3"})


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
    first = small_report().frames[0]
    return [
        replace(first, index=n, cameras=cameras, mean=mean_scores(cameras.values())) for n, cameras in enumerate(frames)
    ]


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
