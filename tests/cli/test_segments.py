# SPDX-License-Identifier: Apache-2.0
"""A folder of segments goes through every command as a file does, and the two are the same bytes."""

import json
import os
import shutil
import signal
from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.cli import options as cli_options
from structgstream.cli.progress import Lines
from structgstream.codec.reader import open_stream
from structgstream.codec.segments.recovery import stale_files
from structgstream.codec.segments.store import CloudStore, FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest, write_archive
from structgstream.session.frame_report import FrameReport
from tests.support.backends import QUICKEST
from tests.support.quick_streams import CLIP, QUARTER, error_of

pytestmark = pytest.mark.usefixtures("quick_tiny")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the same three frames as ``file.sgs`` and as ``segments``."""
    folder = tmp_path_factory.mktemp("made")
    for output, more in ((folder / "file.sgs", []), (folder / "segments", ["--sink", "segments", "--keep", "60"])):
        assert main(["reconstruct", CLIP, "-o", str(output), "--frames", "3", *QUARTER, *more]) == 0
    return folder


def test_the_archive_is_the_file(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    archive = tmp_path / "archive.sgs"
    assert main(["archive", str(made / "segments"), "-o", str(archive)]) == 0
    assert archive.read_bytes() == (made / "file.sgs").read_bytes()
    assert "archive.sgs: 3 frames" in capsys.readouterr().out.replace("\n", "")
    assert main(["archive", str(made / "segments"), "-o", str(archive)]) == 2
    assert "archive.sgs exists; replace it with --overwrite" in capsys.readouterr().err
    assert main(["archive", str(made / "segments"), "-o", str(archive), "--overwrite"]) == 0
    assert main(["archive", str(made), "-o", str(tmp_path / "x.sgs")]) == 1
    assert "has no manifest.json; expected a folder written with --sink segments" in capsys.readouterr().err


def test_inspect_evaluate_render_and_export_give_the_same(made: Path, tmp_path: Path) -> None:
    outputs = []
    for name in ("file.sgs", "segments"):
        stream, out = str(made / name), tmp_path / name
        out.mkdir()
        assert main(["inspect", stream, "--json", str(out / "inspect.json")]) == 0
        assert main(["evaluate", stream, CLIP, "--json", str(out / "scores.json"), "--device", QUICKEST]) == 0
        assert main(["export", stream, "--frame", "2", "-o", str(out / "frame.ply"), "--device", QUICKEST]) == 0
        assert main(["export", stream, "--format", "site", "-o", str(out / "site")]) == 0
        arguments = ["--camera", "cam00", "--frame", "1", "-o", str(out / "view.png"), "--device", QUICKEST]
        assert main(["render", stream, *arguments]) == 0
        scores = json.loads((out / "scores.json").read_text())
        inspected = json.loads((out / "inspect.json").read_text())
        changes = [packet.pop("changes") for packet in inspected["packets"]]
        files = [(out / file).read_bytes() for file in ("frame.ply", "site/stream.sgs", "view.png")]
        outputs.append((scores["mean"]["psnr"], scores["stream"]["total_bytes"], inspected, len(changes), files))
    assert outputs[0] == outputs[1]


def test_what_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, status, message in (
        (["-o", str(tmp_path / "a.sgs"), "--window", "9"], 2, "--window is for --sink segments"),
        (["-o", str(tmp_path / "a"), "--sink", "segments", "--window", "0"], 2, "--window must be a positive number"),
        (["-o", str(tmp_path)], 1, "or add --sink segments"),
    ):
        assert main(["reconstruct", CLIP, *arguments]) == status
        assert message in capsys.readouterr().err.replace("\n", " ")
    (tmp_path / "file").write_text("x")
    assert main(["reconstruct", CLIP, "-o", str(tmp_path / "file"), "--sink", "segments"]) == 1
    assert "cannot be made" in capsys.readouterr().err


def test_sigterm_finishes_the_frame_and_closes_the_stream_which_is_continued_without_saying_what_it_is(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Status 143; with --resume it goes on to the same bytes."""

    def terminated(self: Lines, report: FrameReport, *, quality: str | None = None) -> None:
        if report.index == 1:
            os.kill(os.getpid(), signal.SIGTERM)

    out = tmp_path / "out"
    common = ["reconstruct", CLIP, "-o", str(out), *QUARTER]
    with monkeypatch.context() as patch:
        patch.setattr(Lines, "frame", terminated)
        asked = [*common, "--sink", "segments", "--frames", "12"]
        error = " ".join(error_of(asked, capsys, status=143).split())
    manifest = read_manifest(FolderStore(out))
    assert (manifest.live, manifest.parts, manifest.edge.frame) == (False, (), 1)
    assert f"{out} has 2 of 12 frames; continue with the same command and --resume." in error
    assert "out contains a stream; continue it with --resume" in error_of([*common, "--frames", "3"], capsys, status=1)
    assert main([*common, "--frames", "3", "--resume"]) == 0
    with open_stream(out) as reader:
        assert reader.total_bytes == (made / "file.sgs").stat().st_size
    assert main(["archive", str(out), "-o", str(tmp_path / "a.sgs")]) == 0
    assert (tmp_path / "a.sgs").read_bytes() == (made / "file.sgs").read_bytes()
    assert (tmp_path / "out.log.jsonl").is_file()


def test_publishing(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is missing after a run is copied by the next, also if there is nothing to fit; S3: test_cloud_store.py."""
    out, url = tmp_path / "out", f"file://{tmp_path}/published"
    shutil.copytree(made / "segments", out)
    command = ["reconstruct", CLIP, "-o", str(out), "--frames", "3", *QUARTER, "--sink", "segments", "--publish", url]
    for seconds in (0.0, 120.0):
        monkeypatch.setattr(cli_options, "FINISH_SECONDS", seconds)
        assert main([*command, "--resume"]) == 0
    remote, here = CloudStore(url), FolderStore(out)
    replaced = stale_files(read_manifest(here), here.names())
    assert here.names() - replaced <= remote.names() <= here.names()
    write_archive(remote, tmp_path / "a.sgs")
    assert (tmp_path / "a.sgs").read_bytes() == (made / "file.sgs").read_bytes()
    assert main(["reconstruct", CLIP, "-o", str(tmp_path / "x.sgs"), "--publish", url]) == 2
    assert "--publish is for --sink segments" in capsys.readouterr().err
