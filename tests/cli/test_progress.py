# SPDX-License-Identifier: Apache-2.0
"""Plain lines for files, bars for terminals, the same numbers in both."""

import math
from dataclasses import replace
from typing import Any

import pytest

from structgstream.cli import progress
from structgstream.cli.progress import display, human_bytes, summary
from structgstream.training.result import Step
from tests.support.consoles import console, text
from tests.support.reports import frame_report

REPORT = frame_report(
    1,
    bytes=812_345,
    train_psnr=31.204,
    anchors=34_512,
    moving=34_512,
    free=2_301,
    spawned=5,
    pruned=1,
    seconds={"total": 5.12},
)


def test_a_line_for_each_frame() -> None:
    out = console(terminal=False)
    with display(20, done=1, console=out) as shown:
        shown.step(Step(1, 100, 0.5, 34_512, 0))
        shown.frame(REPORT)
    assert text(out) == "frame  2/20  train 31.20 dB   812.3 kB     5.1 s  34,512 anchors  2,301 free (+5 -1)\n"


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"train_psnr": math.nan}, "frame  2/20  train     - dB "),
        ({"moving": 5_001}, "  34,512 anchors (5,001 moving)  2,301 free"),
        ({"index": 0, "grown": 1_812, "removed": 40}, "  34,512 anchors (+1,812 -40)  2,301 free"),
        (
            {"counts": {"displaced": 40, "views left out": 2, "scene cuts": 0, "spawning refused": 1}},
            "  [2 views left out: only their pictures changed, or theirs did not]  [no births",
        ),
        ({"counts": {"held": 1, "scene cuts": 1}}, "[fewer than two pictures show anything: the scene is held]"),
    ],
)
def test_a_line_tells_what_is_unusual(known: dict[str, Any], said: str) -> None:
    assert said in summary(replace(REPORT, **known), 20)
    assert summary(replace(REPORT, counts={"displaced": 40, "views left out": 0}), 20) == summary(REPORT, 20)


def test_a_long_frame_speaks_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "QUIET_SECONDS", -1.0)
    out = console(terminal=False)
    with display(20, done=4, console=out) as shown:
        shown.step(Step(7, 100, 0.25, 1_000, 0))
    assert text(out) == "frame 5/20: iteration 7/100, loss 0.2500, 1,000 anchors\n"


def test_bars_show_frames_iterations_and_the_last_frame() -> None:
    out = console(terminal=True)
    with display(20, done=1, console=out) as shown:
        shown.step(Step(40, 100, 0.25, 34_512, 7))
        shown.frame(REPORT)
        shown.step(Step(10, 100, 0.25, 34_512, 7))
    final = text(out).splitlines()
    assert any("frames" in line and " 2/20" in line and "5.1 s a frame" in line for line in final)
    assert "frame  2/20  train 31.20 dB" in text(out).splitlines()[-2]


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (999_400, "999.4 kB"), (999_600, "1.0 MB"), (3.2e9, "3.20 GB")],
)
def test_bytes_for_reading(count: float, words: str) -> None:
    assert human_bytes(count) == words


def test_several_qualities_of_a_frame_are_distinguished() -> None:
    for terminal in (False, True):
        out = console(terminal=terminal)
        with display(20, done=1, console=out) as shown:
            for quality in ("low", "high"):
                shown.step(Step(1, 100, 0.5, 34_512, 0))
                shown.frame(REPORT, quality=quality)
        assert "frame  2/20  high  train 31.20 dB" in text(out)
