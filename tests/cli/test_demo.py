# SPDX-License-Identifier: Apache-2.0
"""The command ``demo``."""

import base64
import re
from pathlib import Path

import pytest

from structgstream.cli import render
from structgstream.cli.progress import Lines
from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.session.loop import FrameReport
from tests.support.quick_streams import QUICK, Runner

pytestmark = pytest.mark.usefixtures("quick_presets")


def test_demo_leaves_everything_to_look_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner) -> None:
    monkeypatch.setattr(render, "MIN_PATH_SECONDS", 0.1)
    out = tmp_path / "demo"
    text = run(["demo", "--output", str(out), "--frames", "2", "--scale", "0.25", *QUICK]).out
    made = {str(entry.relative_to(out)) for entry in out.rglob("*") if entry.is_file()}
    made = {name for name in made if not name.startswith("report/worst/")}
    report = {f"report/{name}" for name in ("index.html", "report.json", "over_time.png", "contact_sheet.png")}
    assert made == {"clip.sgs", "clip.log.jsonl", "held-out.mp4", "orbit.mp4", "player.html"} | report
    assert re.search(r"Held-out PSNR [\d.]+ dB \([\d.]+ after frame 0's colour fit\)", text)
    assert all(name.split("/")[-1] in text for name in made - {"clip.log.jsonl"})
    assert (out / "player.html").as_uri() in text
    assert f"structgstream play {out / 'clip.sgs'} --capture {bundled_clip_path()}" in text
    assert base64.b64encode((out / "clip.sgs").read_bytes()) in (out / "player.html").read_bytes()


def test_what_cannot_be_a_demo(tmp_path: Path, run: Runner) -> None:
    (tmp_path / "file").touch()
    assert "--output is a folder" in run(["demo", "-o", str(tmp_path / "file")], status=2).err
    out = ["demo", "-o", str(tmp_path / "new")]
    assert "has 12 frames" in run([*out, "--frames", "13"], status=1).err
    assert "must lie in (0, 1]" in run([*out, "--scale", "nan"], status=1).err
    assert "there is no preset 'tny'" in run([*out, "--preset", "tny"], status=2).err
    assert not (tmp_path / "new").exists()


def test_an_interrupted_demo_says_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner) -> None:
    def interrupted(self: Lines, report: FrameReport, *, quality: str | None = None) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Lines, "frame", interrupted)
    arguments = ["demo", "-o", str(tmp_path / "demo"), "--frames", "2", "--scale", "0.25", *QUICK]
    error = run(arguments, status=130).err
    assert f"What was done is in {tmp_path / 'demo'}; the demo starts again" in error
    assert [path.name for path in (tmp_path / "demo").glob("*.sgs")] == ["clip.sgs"]
