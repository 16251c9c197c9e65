# SPDX-License-Identifier: Apache-2.0
"""The command ``demo``."""

import base64
import re
from pathlib import Path

import pytest

from structgstream.cli import main, render
from structgstream.cli.progress import Lines
from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.session.loop import FrameReport
from tests.support.quick_streams import QUICK, error_of

pytestmark = pytest.mark.usefixtures("quick_presets")


def test_demo_leaves_everything_to_look_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(render, "MIN_PATH_SECONDS", 0.1)
    out = tmp_path / "demo"
    assert main(["demo", "--output", str(out), "--frames", "2", "--scale", "0.25", *QUICK]) == 0
    made = {str(entry.relative_to(out)) for entry in out.rglob("*") if entry.is_file()}
    made = {name for name in made if not name.startswith("report/worst/")}
    report = {f"report/{name}" for name in ("index.html", "report.json", "over_time.png", "contact_sheet.png")}
    assert made == {"clip.sgs", "clip.log.jsonl", "held-out.mp4", "orbit.mp4", "player.html"} | report
    text = capsys.readouterr().out
    assert re.search(r"Held-out PSNR [\d.]+ dB \([\d.]+ after frame 0's colour fit\)", text)
    assert all(name.split("/")[-1] in text for name in made - {"clip.log.jsonl"})
    assert (out / "player.html").as_uri() in text
    assert f"structgstream play {out / 'clip.sgs'} --capture {bundled_clip_path()}" in text
    assert base64.b64encode((out / "clip.sgs").read_bytes()) in (out / "player.html").read_bytes()


def test_what_cannot_be_a_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert "--output is a folder" in error_of(["demo", "-o", str(tmp_path / "file")], capsys, status=2)
    out = ["demo", "-o", str(tmp_path / "new")]
    assert "has 12 frames" in error_of([*out, "--frames", "13"], capsys, status=1)
    assert "must lie in (0, 1]" in error_of([*out, "--scale", "nan"], capsys, status=1)
    assert "there is no preset 'tny'" in error_of([*out, "--preset", "tny"], capsys, status=2)
    assert not (tmp_path / "new").exists()


def test_an_interrupted_demo_says_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(self: Lines, report: FrameReport, *, quality: str | None = None) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Lines, "frame", interrupted)
    arguments = ["demo", "-o", str(tmp_path / "demo"), "--frames", "2", "--scale", "0.25", *QUICK]
    error = error_of(arguments, capsys, status=130)
    assert f"What was done is in {tmp_path / 'demo'}; the demo starts again" in error
    assert [path.name for path in (tmp_path / "demo").glob("*.sgs")] == ["clip.sgs"]
