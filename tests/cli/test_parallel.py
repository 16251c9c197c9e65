# SPDX-License-Identifier: Apache-2.0
"""``parallel`` on the bundled clip, and what it says when something is wrong."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.cli import main, parallel
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
from tests.support.quick_streams import CLIP, QUARTER, error_of
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
    stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
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
    capsys.readouterr()
    assert main(["track", *given, "-o", track, "--groups", "2", "--allow-unaligned", "--frames", "4"]) == 0
    assert "2 groups in" in capsys.readouterr().out
    assert main(["fit-group", *given, "--track", track, "--frames", "2:4", "-o", str(segments[1])]) == 0
    assert "is finished" in capsys.readouterr().out


def test_again_it_says_so_and_makes_nothing(stream: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in stream.parent.rglob("*0*.sgs")}
    capsys.readouterr()
    assert main(["parallel", CLIP, "-o", str(stream), *GROUPS, *QUARTER]) == 0
    assert "groups: 2 of 2 groups done" in capsys.readouterr().out
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
        (
            ["--groups", "7", "--frames", "8", *QUARTER],
            1,
            "Groups of 7 frames cost a key packet each",
        ),
    ],
)
def test_wrong_options_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], status: int, said: str
) -> None:
    assert said in error_of(["parallel", CLIP, "-o", str(tmp_path / "out.sgs"), *words], capsys, status=status)
    assert not (tmp_path / "out.sgs").exists()


def test_frame_zero_is_fitted_to_the_part_that_was_chosen() -> None:
    chosen = CaptureOptions(scale=0.5, start=3, every=2)
    unit = _job(Parallel(Path("capture"), Path("out.sgs"), capture=chosen), []).unit
    assert unit.header == ("--scale", "0.5", "--start", "3", "--every", "2")


def test_an_output_that_is_no_parallel_run_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out.sgs").write_bytes(b"mine")
    assert "exists; replace it with --overwrite" in error_of(
        ["parallel", CLIP, "-o", str(tmp_path / "out.sgs"), *GROUPS], capsys, status=1
    )
    assert (tmp_path / "out.sgs").read_bytes() == b"mine"


def test_another_stream_that_was_written_after_the_run_is_not_replaced(
    stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts, out = parts_folder(stream), tmp_path / "out.sgs"
    shutil.copytree(parts, parts_folder(out))
    out.write_bytes(small_stream())
    error = error_of(["parallel", CLIP, "-o", str(out), *GROUPS, *QUARTER], capsys, status=1)
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
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    more: list[str],
    capture: str,
    whose: str,
    status: int,
    said: str,
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
        assert owner is not None
        ObjectFolder(f"file://{store}").write(MARKER, owner.content)
    before = snapshot(tmp_path)
    words = ["parallel", capture, "-o", str(output), "--store", f"file://{store}"]
    assert said in error_of([*words, "--frames", "3", *QUARTER, *more], capsys, status=status)
    assert snapshot(tmp_path) == before


def test_a_wrong_capture_leaves_nothing_behind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error_of(["parallel", "/no/such/capture", "-o", str(tmp_path / "out.sgs")], capsys, status=1)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "device", "gpus", "words"),
    [
        (WorkerOptions(workers=1, threads=1), "cpu", 0, ("--device", "cpu", "--workers", "1")),
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


def test_joining_takes_all_cores_that_the_workers_have() -> None:
    assert join_arguments(WorkerOptions(), "cpu") == ("--device", "cpu", "--workers", str(usable_cores()))
