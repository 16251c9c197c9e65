# SPDX-License-Identifier: Apache-2.0
"""The commands parallel, on the bundled clip, and plan, from a run whose measurements are known; what they refuse."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.cli import app, main, parallel
from structgstream.cli.options import CaptureOptions, Device
from structgstream.cli.parallel import Parallel, WorkerOptions, _job, join_arguments, parts_folder
from structgstream.codec.reader import open_stream
from structgstream.evaluation.environment import usable_cores
from structgstream.executors.tasks import ExecutorOptions, TaskQueue, TaskResult, open_executor
from structgstream.owned_folders import MARKER, Owner
from structgstream.parallel.exchange import ObjectFolder
from structgstream.parallel.parts import PURPOSE, Parts
from tests.support.backends import QUICKEST
from tests.support.inline_engine import InlineEngine
from tests.support.measured_runs import finished_run
from tests.support.quick_streams import CLIP, QUARTER, Runner
from tests.support.streams import small_stream

GROUPS = ["--frames", "4", "--groups", "2", "--allow-unaligned"]
pytestmark = pytest.mark.usefixtures("quick_tiny")


@pytest.fixture(scope="module", autouse=True)
def in_this_process() -> Iterator[None]:
    """Tasks run in this process, where the preset is the quick one."""

    def opened(options: ExecutorOptions, device: str) -> TaskQueue:
        open_executor(options, cores=1).close()
        return TaskQueue(InlineEngine())

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(parallel, "open_tasks", opened)
        yield


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames in groups of two, hardly trained."""
    path = tmp_path_factory.mktemp("parallel") / "clip.sgs"
    assert main(["parallel", CLIP, "-o", str(path), *GROUPS, *QUARTER]) == 0
    return path


def test_the_result_is_a_stream_of_what_the_commands_of_its_parts_make(
    stream: Path, tmp_path: Path, run: Runner
) -> None:
    with open_stream(stream) as reader:
        assert (len(reader), reader.complete) == (4, True)
    parts, out = stream.with_name("clip.sgs.parts"), tmp_path / "joined.sgs"
    segments = sorted((parts / "segments").glob("*.sgs"))
    assert [path.name for path in segments] == ["group-000000-000002.sgs", "group-000002-000004.sgs"]
    assert main(["join", *map(str, reversed(segments)), "-o", str(out), "--check", "--device", QUICKEST]) == 0
    assert out.read_bytes() == stream.read_bytes()
    given = [CLIP, "--init", str(parts / "header.sgs"), "--device", QUICKEST]
    track = str(parts / "track.sgt")
    tracked = ["track", *given, "-o", track, "--groups", "2", "--allow-unaligned", "--frames", "4"]
    assert "2 groups in" in run(tracked).out
    assert "is finished" in run(["fit-group", *given, "--track", track, "--frames", "2:4", "-o", str(segments[1])]).out


def test_again_it_says_so_and_makes_nothing(stream: Path, run: Runner) -> None:
    before = {path: path.stat().st_mtime_ns for path in stream.parent.rglob("*0*.sgs")}
    assert "groups: 2 of 2 groups done" in run(["parallel", CLIP, "-o", str(stream), *GROUPS, *QUARTER]).out
    assert {path: path.stat().st_mtime_ns for path in stream.parent.rglob("*0*.sgs")} == before


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["--groups", "0"], 2, "--groups counts frames, from 1; got 0."),
        (["--address", "head:1"], 2, "--address is the head of a Ray cluster; add --executor ray."),
        (["--workers", "0"], 2, "The number of workers must be 1 or more, got 0."),
        (["--preset", "tny"], 2, "there is no preset 'tny'"),
        (["--preset", "rig"], 1, "scene flow off; groups need the codec compact and scene flow"),
        (["--online.iteration", "5"], 2, "--online.iterations"),
        (["--groups", "7", "--frames", "8", *QUARTER], 1, "Groups of 7 frames cost a key packet each"),
    ],
)
def test_wrong_options_are_reported(tmp_path: Path, run: Runner, words: list[str], status: int, said: str) -> None:
    assert said in run(["parallel", CLIP, "-o", str(tmp_path / "out.sgs"), *words], status=status).err
    assert not (tmp_path / "out.sgs").exists()


def test_frame_zero_is_fitted_to_the_part_that_was_chosen() -> None:
    chosen = CaptureOptions(scale=0.5, start=3, every=2)
    unit = _job(Parallel(Path("capture"), Path("out.sgs"), capture=chosen), []).unit
    assert unit.header == ("--scale", "0.5", "--start", "3", "--every", "2")


def test_an_output_that_is_no_parallel_run_is_not_replaced(tmp_path: Path, run: Runner) -> None:
    (tmp_path / "out.sgs").write_bytes(b"mine")
    error = run(["parallel", CLIP, "-o", str(tmp_path / "out.sgs"), *GROUPS], status=1).err
    assert "exists; replace it with --overwrite" in error
    assert (tmp_path / "out.sgs").read_bytes() == b"mine"


def test_another_stream_that_was_written_after_the_run_is_not_replaced(
    stream: Path, tmp_path: Path, run: Runner
) -> None:
    parts, out = parts_folder(stream), tmp_path / "out.sgs"
    shutil.copytree(parts, parts_folder(out))
    out.write_bytes(small_stream())
    error = run(["parallel", CLIP, "-o", str(out), *GROUPS, *QUARTER], status=1).err
    assert f"out.sgs is not the stream that was joined from {parts_folder(out)}" in error
    assert out.read_bytes() == small_stream()


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("more", [[], ["--overwrite"], ["--overwrite", "--groups", "2", "--allow-unaligned"]])
@pytest.mark.parametrize(
    ("capture", "whose", "status", "said"),
    [
        ("/no/such/capture", "ours", 1, "/no/such/capture"),
        (CLIP, "parts", 1, "out.sgs.parts is needed for the parts of a parallel run, and contains files"),
        (CLIP, "store", 1, "holds objects and no marker of structgstream"),
        (CLIP, "other run", 1, "holds the parts of another run than"),
    ],
)
def test_folders_and_stores_of_others_are_refused_with_every_option_and_nothing_is_gone(
    tmp_path: Path, run: Runner, more: list[str], capture: str, whose: str, status: int, said: str
) -> None:
    output, store = tmp_path / "out.sgs", tmp_path / "store"
    parts = Parts(tmp_path / "out.sgs.parts")
    store.mkdir()
    output.write_bytes(b"mine")
    if whose == "parts":
        parts.folder.mkdir()
        (parts.folder / "plan.json").write_text("{}")
    else:
        with parts.locked():
            parts.header.write_bytes(b"mine")
            parts.record(TaskResult("header", 0, 1.0), "key", parts.header, frames=1)
            parts.record(TaskResult("join", 0, 1.0), "key", output, frames=1)
    (store / "segments").mkdir()
    (store / "segments" / "group-000000-000004.sgs").write_bytes(b"mine")
    if whose in ("ours", "other run"):
        owner = parts.check() if whose == "ours" else Owner.new(PURPOSE)
        ObjectFolder(f"file://{store}").write(MARKER, owner.content)
    before = snapshot(tmp_path)
    words = ["parallel", capture, "-o", str(output), "--store", f"file://{store}"]
    assert said in run([*words, "--frames", "3", *QUARTER, *more], status=status).err
    assert snapshot(tmp_path) == before


def test_a_wrong_capture_leaves_nothing_behind(tmp_path: Path, run: Runner) -> None:
    run(["parallel", "/no/such/capture", "-o", str(tmp_path / "out.sgs")], status=1)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "device", "gpus", "words"),
    [
        (WorkerOptions(workers=1, threads=1), "cpu", 0, ("--device", "cpu", "--workers", "1")),
        (WorkerOptions(), "cpu", 0, ("--device", "cpu", "--workers", str(usable_cores()))),
        (WorkerOptions("ray"), "cpu", 0, ("--device", "cpu")),
        (WorkerOptions("ray"), "cuda", 0, ("--device", "auto")),
        (WorkerOptions("ray"), "cuda", 1, ("--device", "cuda")),
        (WorkerOptions(), "cuda", 1, ("--device", "cuda")),
    ],
)
def test_joining_takes_what_this_machine_has_and_no_more_processes_than_the_run_has_threads(
    options: WorkerOptions, device: Device, gpus: int, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "gpus_of", lambda device: gpus)
    assert join_arguments(options, device) == words


@pytest.fixture
def parts(tmp_path: Path) -> str:
    return str(finished_run(tmp_path))


def test_plan_reads_a_run(parts: str, tmp_path: Path, run: Runner) -> None:
    path = tmp_path / "plan.json"
    words = ["--run", parts, "--length", "3000", "--machines", "1", "8", "--finish-hours", "1000", "--json", str(path)]
    text = run(["plan", CLIP, "--preset", "tiny", *words]).out
    assert "3000 frames (100.0 s of film) in 100 groups of 30." in text
    assert "frame 0 30.0 s, tracking 0.50 s a frame, a group 10.0 s and 2.00 s a frame (2 groups)" in text
    assert "Within 1000 h: 1 workers" in text
    assert "0.50 frames a second here, 60.0 times too slow for 30." in text
    assert "Assumed:" in text
    facts = json.loads(path.read_text())
    one, eight = facts["estimates"]
    assert (one["machines"], eight["machines"]) == (1, 8)
    assert eight["seconds"] < one["seconds"]
    assert (facts["measured"]["frames"], facts["measured"]["costs"]["frame_seconds"]) == (12, 2.0)
    assert facts["wanted"]["workers"] == 1


def test_a_finish_that_no_number_reaches_is_said(parts: str, run: Runner) -> None:
    words = ["--run", parts, "--length", "3000", "--finish-hours", "0.01"]
    assert "Within 0.01 h: not possible; least " in run(["plan", CLIP, "--preset", "tiny", *words]).out


def test_workers_of_a_machine_count(parts: str, tmp_path: Path) -> None:
    seconds = []
    for machines, workers in (("4", "1"), ("2", "2")):
        path = tmp_path / "plan.json"
        words = ["--run", parts, "--length", "300", "--machines", machines, "--workers", workers, "--json", str(path)]
        assert main(["plan", CLIP, "--preset", "tiny", *words]) == 0
        seconds.append(json.loads(path.read_text())["estimates"][0]["seconds"])
    assert seconds[0] == seconds[1]


@pytest.mark.parametrize("words", [[], ["-o", "probe", "--run", "parts"]])
def test_plan_wants_a_probe_or_a_run(words: list[str], run: Runner) -> None:
    error = run(["plan", CLIP, *words], status=2).err
    assert "give either -o FOLDER for a probe, or --run" in error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--workers", "0"], "--machines and --workers count from 1."),
        (["--machines", "4", "0"], "--machines and --workers count from 1."),
        (["--length", "-1"], "-1"),
        (["--groups", "-2"], "-2"),
        (["--preset", "tny"], "there is no preset 'tny'"),
    ],
)
def test_numbers_that_mean_nothing_are_refused(parts: str, words: list[str], said: str, run: Runner) -> None:
    assert said in run(["plan", CLIP, "--run", parts, *words], status=2).err


def test_plan_says_that_a_run_is_not_there(tmp_path: Path, run: Runner) -> None:
    error = run(["plan", CLIP, "--run", str(tmp_path)], status=1).err
    assert "has no finished parallel run" in error
    assert error.count("\n") == 1


def test_a_probe_is_a_short_run_with_the_same_options(
    parts: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[list[str]] = []
    real = app.main

    def command(words: list[str]) -> int:
        given.append(words)
        (tmp_path / "probe").mkdir()
        Path(parts).rename(tmp_path / "probe" / "probe.sgs.parts")
        return 0

    monkeypatch.setattr(app, "main", command)
    words = ["-o", str(tmp_path / "probe"), "--preset", "tiny", "--held-out", "cam01", "--scale", "0.5"]
    words += ["--every", "2"]
    assert real(["plan", CLIP, *words, "--online.iterations", "9"]) == 0
    (asked,) = given
    assert asked[:4] == ["parallel", CLIP, "-o", str(tmp_path / "probe" / "probe.sgs")]
    text = " ".join(asked)
    same = ("--preset tiny", "--held-out cam01", "--scale 0.5", "--every 2")
    for part in (f"--frames {parallel.PROBE_FRAMES}", *same, "--workers 1"):
        assert part in text
    assert text.endswith("--online.iterations 9")


@pytest.mark.parametrize("status", [1, 130])
def test_the_status_of_a_probe_that_fails_is_that_of_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    real = app.main
    monkeypatch.setattr(app, "main", lambda words: status)
    assert real(["plan", CLIP, "-o", str(tmp_path / "probe"), "--preset", "tiny"]) == status


def test_a_probe_whose_folder_cannot_be_made_is_reported(tmp_path: Path, run: Runner) -> None:
    (tmp_path / "file").touch()
    error = run(["plan", CLIP, "-o", str(tmp_path / "file" / "probe"), "--preset", "tiny"], status=1).err
    assert "cannot be" in error
    assert "unexpected" not in error
