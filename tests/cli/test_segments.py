# SPDX-License-Identifier: Apache-2.0
"""A folder of segments goes through every command as a file does, with its bytes; several qualities at once."""

import json
import math
import os
import shutil
import signal
from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.cli import options as cli_options
from structgstream.cli.app import UsageError
from structgstream.cli.options import SegmentOptions
from structgstream.cli.progress import Lines
from structgstream.codec.reader import open_stream
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import QUALITIES
from structgstream.codec.segments.recovery import stale_files
from structgstream.codec.segments.sink import Clocks
from structgstream.codec.segments.store import CloudStore, FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest, write_archive
from structgstream.session.frame_report import FrameReport
from tests.data.live.test_live_source import files
from tests.support.backends import QUICKEST
from tests.support.quick_streams import CLIP, QUARTER, Runner
from tests.support.segment_streams import header, packets

pytestmark = pytest.mark.usefixtures("quick_tiny")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the same three frames as ``file.sgs`` and as ``segments``."""
    folder = tmp_path_factory.mktemp("made")
    for output, more in ((folder / "file.sgs", []), (folder / "segments", ["--sink", "segments", "--keep", "60"])):
        assert main(["reconstruct", CLIP, "-o", str(output), "--frames", "3", *QUARTER, *more]) == 0
    return folder


def test_the_archive_is_the_file(made: Path, tmp_path: Path, run: Runner) -> None:
    archive = ["archive", str(made / "segments"), "-o", str(tmp_path / "archive.sgs")]
    assert "archive.sgs: 3 frames" in run(archive).out.replace("\n", "")
    assert (tmp_path / "archive.sgs").read_bytes() == (made / "file.sgs").read_bytes()
    assert "archive.sgs exists; replace it with --overwrite" in run(archive, status=2).err
    run([*archive, "--overwrite"])
    error = run(["archive", str(made), "-o", str(tmp_path / "x.sgs")], status=1).err
    assert "has no manifest.json; expected a folder written with --sink segments" in error


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


def test_what_is_refused(tmp_path: Path, run: Runner) -> None:
    (tmp_path / "file").write_text("x")
    for arguments, status, message in (
        (["-o", str(tmp_path / "a.sgs"), "--window", "9"], 2, "--window is for --sink segments"),
        (["-o", str(tmp_path)], 1, "or add --sink segments"),
        (["-o", str(tmp_path / "file"), "--sink", "segments"], 1, "cannot be made"),
    ):
        assert message in run(["reconstruct", CLIP, *arguments], status=status).err.replace("\n", " ")


def test_sigterm_finishes_the_frame_and_closes_the_stream_which_is_continued_without_saying_what_it_is(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner
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
        error = " ".join(run(asked, status=143).err.split())
    manifest = read_manifest(FolderStore(out))
    assert (manifest.live, manifest.parts, manifest.edge.frame) == (False, (), 1)
    assert f"{out} has 2 of 12 frames; continue with the same command and --resume." in error
    assert "out contains a stream; continue it with --resume" in run([*common, "--frames", "3"], status=1).err
    assert main([*common, "--frames", "3", "--resume"]) == 0
    with open_stream(out) as reader:
        assert reader.total_bytes == (made / "file.sgs").stat().st_size
    assert main(["archive", str(out), "-o", str(tmp_path / "a.sgs")]) == 0
    assert (tmp_path / "a.sgs").read_bytes() == (made / "file.sgs").read_bytes()
    assert (tmp_path / "out.log.jsonl").is_file()


def test_publishing(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner) -> None:
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
    error = run(["reconstruct", CLIP, "-o", str(tmp_path / "x.sgs"), "--publish", url], status=2).err
    assert "--publish is for --sink segments" in error


def test_what_is_there_says_how_it_is_written(tmp_path: Path) -> None:
    assert SegmentOptions().chosen(tmp_path / "new.sgs") == "file"
    (tmp_path / "studio").mkdir()
    assert SegmentOptions().chosen(tmp_path / "studio") == "file"
    (tmp_path / "studio" / MANIFEST).touch()
    assert SegmentOptions().chosen(tmp_path / "studio") == "segments"
    assert SegmentOptions(sink="file").chosen(tmp_path / "studio") == "file"
    for window, keep in ((0.1, 0.0), (1e6, math.inf)):
        assert SegmentOptions(sink="segments", window=window, keep=keep).chosen(tmp_path / "x") == "segments"


@pytest.mark.parametrize(
    ("window", "keep"), [(0.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (math.inf, 1.0), (1.0, -1.0), (1.0, math.nan)]
)
def test_seconds_that_make_no_sense(tmp_path: Path, window: float, keep: float) -> None:
    with pytest.raises(UsageError, match="--window must be a positive number of seconds, and --keep zero or more"):
        SegmentOptions(sink="segments", window=window, keep=keep).chosen(tmp_path / "x")


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize(
    ("clocks", "captured"), [(None, None), (Clocks(captured=lambda frame: 1.7e9 + frame), 1.7e9 + 11)]
)
def test_window_grace_and_when_a_live_frame_was_filmed_arrive(
    tmp_path: Path, clocks: Clocks | None, captured: float | None
) -> None:
    options = SegmentOptions(sink="segments", window=0.05, keep=0.0)
    with options.storage(tmp_path / "now", may_exist=False, report=print, clocks=clocks) as storage:
        sink, resumed = storage(False)
        assert resumed is None
        sink.open(header())
        for packet in packets(12):
            sink.write(packet)
        sink.close()
    manifest = read_manifest(FolderStore(tmp_path / "now"))
    assert (manifest.window.seconds, manifest.edge.captured_unix_seconds) == (0.05, captured)
    assert manifest.window.first_frame > 0
    assert not (tmp_path / "now" / manifest.segments[1].file).exists()


NAMES = ("low", "high")
GIVEN = ["--sink", "segments", "--qualities", "high=1.5", "low=-2"]


def asked(out: Path, *more: str, frames: int = 3) -> list[str]:
    return ["reconstruct", CLIP, "-o", str(out), "--frames", str(frames), *QUARTER, *GIVEN, *more]


def archived(folder: Path, out: Path) -> bytes:
    assert main(["archive", str(folder), "-o", str(out), "--overwrite"]) == 0
    return out.read_bytes()


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of the clip in two qualities."""
    out = tmp_path_factory.mktemp("both") / "out"
    assert main(asked(out)) == 0
    return out


def test_the_list_the_logs_and_the_numbers_lie_beside_the_streams(both: Path) -> None:
    """What is in them: qualities/test_recording.py."""
    values = json.loads(both.with_suffix(".metrics.json").read_text())
    assert (values["state"], [values["qualities"][name]["frames"] for name in NAMES]) == ("finished", [3, 3])
    assert both.with_suffix(".log.jsonl").is_file()
    assert {path.name for path in both.iterdir()} == {QUALITIES, *NAMES, *(f"{name}.log.jsonl" for name in NAMES)}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--quality", "1"], "got --quality besides"),
        (["--mbits", "5"], "got --mbits besides"),
        (["--sink", "file"], "got --sink file; add --sink segments"),
        (["--publish", "s3://bucket/x"], "--publish copies one stream"),
        (["--window", "0"], "--window must be a positive number"),
        (["--qualities", "low=1"], "got 1; for a single one give --quality"),
        (["--preset", "rig"], "got the codec raw; add --preset compact"),
        (["--resume", "--overwrite"], "choose one"),
        (["--record", "take"], "give --live and a rig file"),
    ],
)
def test_options_that_make_no_sense(tmp_path: Path, more: list[str], said: str, run: Runner) -> None:
    error = run([*asked(tmp_path / "out"), *more], status=2).err
    assert said in " ".join(error.split())
    assert not (tmp_path / "out" / QUALITIES).exists()


def test_without_a_word_on_segments_it_is_refused(tmp_path: Path, run: Runner) -> None:
    command = ["reconstruct", CLIP, "-o", str(tmp_path / "x.sgs"), *QUARTER, "--qualities", "low=-1", "high=1"]
    assert "got no --sink; add --sink segments" in run(command, status=2).err
    assert not [*tmp_path.iterdir()]


def test_a_folder_of_something_else_is_left_alone(both: Path, tmp_path: Path, run: Runner) -> None:
    before = {path: path.read_bytes() for path in both.rglob("*") if path.is_file()}
    for more in (["--resume"], ["--overwrite"]):
        other = [word if word != "low=-2" else "lowest=-2" for word in asked(both, *more)]
        assert "holds the qualities low, high, got lowest, high; give the same" in run(other, status=2).err
        one = ["reconstruct", CLIP, "-o", str(both), *QUARTER, "--sink", "segments", *more]
        assert "holds several qualities of one stream" in run(one, status=2).err
    finer = [word if word != "low=-2" else "low=-1" for word in asked(both, "--resume")]
    assert "online.rounding.quality differ" in run(finer, status=1).err
    assert {path: path.read_bytes() for path in both.rglob("*") if path.is_file()} == before
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "manifest.json").write_text("{}")
    assert "holds one stream, and --qualities writes several" in run(asked(tmp_path / "one"), status=2).err


def test_ctrl_c_finishes_the_frame_in_all_and_resume_without_a_word_on_segments_goes_on(
    both: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner
) -> None:
    out, line = tmp_path / "out", Lines.frame

    def interrupted(self: Lines, report: FrameReport, *, quality: str | None = None) -> None:
        line(self, report, quality=quality)
        if (report.index, quality) == (1, "low"):
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Lines, "frame", interrupted)
        said = run(asked(out), status=130)
    error = " ".join(said.err.split())
    assert "has 2 of 3 frames in all qualities; continue with the same command and --resume" in error
    # Without those of iterations, which come where a frame takes long.
    lines = [line.split("  ")[:2] for line in said.out.splitlines() if line.startswith("frame ") and "  " in line]
    assert lines == [[f"frame {number}/3", name] for number in (1, 2) for name in NAMES]
    for name in NAMES:
        manifest = read_manifest(FolderStore(out / name))
        assert (manifest.edge.frame, manifest.live) == (1, False)
    error = run(asked(out), status=1).err
    assert "contains a stream; continue it with --resume" in error
    resumed = run([word for word in asked(out, "--resume") if word not in ("--sink", "segments")]).out
    assert f"Wrote {out}: low, high" in resumed.replace("\n", " ")
    for name in NAMES:
        assert archived(out / name, tmp_path / "a.sgs") == archived(both / name, tmp_path / "b.sgs")


def live_run(out: Path, rig: Path, *more: str) -> int:
    return main(["reconstruct", str(rig), "-o", str(out), "--live", *QUARTER[2:], *GIVEN, *more])


def test_live_cameras_are_read_once_for_all_and_a_resumed_run_goes_on(tmp_path: Path) -> None:
    rig, out = files(tmp_path, frames=60), tmp_path / "out"
    assert live_run(out, rig, "--frames", "2", "--record", str(tmp_path / "take")) == 0
    assert live_run(out, rig, "--frames", "4", "--resume") == 0
    readers = [open_stream(out / name) for name in NAMES]
    times = [[(info.index, info.pts_seconds) for info in reader.packets] for reader in readers]
    assert times[0] == times[1]
    assert len(times[0]) == 4
    assert times[0] == sorted(times[0], key=lambda one: one[1])
    manifests = [read_manifest(FolderStore(out / name)) for name in NAMES]
    captured = [one.edge.captured_unix_seconds for one in manifests]
    assert captured[0] == captured[1]
    assert captured[0] is not None
    assert len([*(tmp_path / "take").glob("*.ts")]) == 3
    last = json.loads((tmp_path / "out.log.jsonl").read_text().splitlines()[-1])
    assert set(last["qualities"]) == set(NAMES)
    assert set(last["run"]["live"]["cameras"]) == {"a", "b", "c"}
