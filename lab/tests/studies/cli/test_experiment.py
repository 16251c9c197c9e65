# SPDX-License-Identifier: Apache-2.0
"""``ablate`` and ``compare`` on the bundled clip, and what they say when something is wrong."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from rich.console import Console

from structgstream.cli import main
from structgstream.cli.app import UsageError
from structgstream.cli.options import CaptureOptions, resolve_config
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.source import WithRig
from structgstream.kernels.backend import select_backend
from structgstream.session.presets import PRESETS, StreamConfig
from structgstream_studies.cli.dataset import captures_in
from structgstream_studies.cli.experiment import Display, ExperimentOptions, capture_part, print_sheet
from structgstream_studies.experiments.captures import CapturePart
from structgstream_studies.experiments.results import read_results
from structgstream_studies.experiments.sheets import Sheet
from structgstream_studies.experiments.studies import ablation_runs, with_dependencies
from structgstream_studies.experiments.sweep import Outcome, Progress
from structgstream_studies.experiments.tasks import VariantRun
from structgstream_studies.experiments.worker import Task
from tests.support.backends import QUICKEST
from tests.support.quick_streams import CLIP, error_of
from tests.support.small_presets import few_points

ROOT = Path(__file__).parents[4]
SMALL = ["--frames", "2", "--scale", "0.25", "--seeds", "0", "--device", QUICKEST, "--jobs", "2"]
QUICK = ["--preset", "tiny", "--initial.iterations", "3", "--online.iterations", "2"]
QUICK += ["--online.patching.iteration", "1", "--initial.losses.offset_distance", "0.005"]


def with_iterations(config: StreamConfig, iterations: int) -> StreamConfig:
    return replace(config, online=replace(config.online, iterations=iterations))


def ablate(folder: Path) -> list[str]:
    return ["ablate", CLIP, "--table", "distance", "-o", str(folder), *SMALL, *QUICK]


def contents(folder: Path) -> dict[str, int]:
    """When each stream, log and result was written."""
    files = [path for name in ("first", "streams", "results") for path in (folder / name).iterdir()]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


@pytest.fixture(scope="module", autouse=True)
def quick_presets() -> Iterator[None]:
    with few_points("tiny"), pytest.MonkeyPatch.context() as patch:
        # Workers unpickle the class of these presets.
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]))
        yield


@pytest.fixture(scope="module")
def ablated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table of the distance regularisation, of which all but one step was done before."""
    folder, backend = tmp_path_factory.mktemp("ablate") / "out", select_backend(QUICKEST)
    config, _ = resolve_config(QUICK[1], QUICK[2:], command="ablate", seed=None)
    part = CapturePart(Path(CLIP), scale=0.25, frames=2)
    *tasks, last = with_dependencies(ablation_runs(["distance"], config, part, frames=2, seeds=(0,), folder=folder))
    assert len(tasks) == 7
    for task in tasks:
        task.run(backend)
    before = contents(folder)
    assert main(ablate(folder)) == 0
    assert last.done()
    assert before.items() <= contents(folder).items()
    assert [path.name for path in (folder / "logs").iterdir()] == [f"{last.name}.txt"]
    return folder


def test_ablate_leaves_table_pictures_results_and_streams(ablated: Path) -> None:
    table = (ablated / "distance.md").read_text()
    assert table.startswith("# Distance regularisation at frame 0\n")
    assert "| full method |" in table
    assert "| w/o distance regularisation |" in table
    for name in ("distance-curves.png", "distance-detail.png"):
        picture = cv2.imread(str(ablated / name))
        assert picture is not None
        assert picture.std() > 5
    assert {(result.key, result.seed) for result in read_results(ablated / "results")} == {
        ("full", 0),
        ("without-distance", 0),
        ("acting-distance", 0),
        ("printed-distance", 0),
    }
    assert len(list((ablated / "first").glob("*.sgs"))) == 4
    assert len(list((ablated / "streams").glob("*.sgs"))) == 4
    assert not list(ablated.rglob("*.partial"))


def test_dataset_runs_every_capture_and_prints_our_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("one", "two"):
        (tmp_path / "scenes" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "scenes" / name).symlink_to(CLIP, target_is_directory=True)
    asked = ["dataset", str(tmp_path / "scenes"), "n3dv", "-o", str(tmp_path / "out"), "--preset", "tiny"]
    assert main([*asked, *SMALL]) == 0
    table = (tmp_path / "out" / "dataset.md").read_text()
    results = [read_results(tmp_path / "out" / name / "results")[0] for name in ("one", "two")]
    assert [result.identity["capture"]["held_out"] for result in results] == [["cam00"], ["cam00"]]
    assert f"{(results[0].mean['psnr'] + results[1].mean['psnr']) / 2:.2f}" in table.splitlines()[-1]
    assert "| cited: 3DGStream |" in table
    with pytest.raises(UsageError, match="has no folders of captures"):
        captures_in(tmp_path / "out" / "one" / "results")


def test_a_second_time_prints_the_table_and_does_nothing_again(
    ablated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(ablated)
    table = (ablated / "distance.md").read_text()
    capsys.readouterr()
    assert main(ablate(ablated)) == 0
    text = capsys.readouterr().out
    assert contents(ablated) == before
    assert (ablated / "distance.md").read_text() == table
    assert "4 of 4 steps were done already." in text
    assert f"{read_results(ablated / 'results')[0].mean['psnr']:.2f}" in text
    assert "w/o distance" in text
    assert f"Tables and pictures: {ablated}" in text


@pytest.mark.parametrize(
    ("command", "extra", "status", "words"),
    [
        ("ablate", ["--table", "colours"], 2, "colours"),
        ("ablate", ["--preset", "tny"], 2, "there is no preset 'tny'"),
        ("ablate", ["--online.iteration", "5"], 2, "--online.iterations"),
        ("ablate", ["--scored", "cam03"], 2, "camera 'cam03' is not held out; held out are cam00."),
        ("ablate", ["--held-out", "cam77"], 1, "cam77"),
        ("ablate", ["--jobs", "0"], 1, "1 or more, got 0"),
        ("ablate", ["--frames", "13"], 1, "has 12 frames"),
        ("compare", ["--scored", "cam03"], 2, "camera 'cam03' is not held out"),
        ("compare", ["--methods", "nerf"], 1, "There is no method 'nerf'; there are"),
        ("compare", ["--scratch-every", "0"], 2, "--scratch-every counts frames, from 1; got 0."),
    ],
)
def test_wrong_options_are_reported_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, extra: list[str], status: int, words: str
) -> None:
    out = tmp_path / "out"
    error = error_of([command, CLIP, "-o", str(out), "--device", QUICKEST, *extra], capsys, status=status)
    assert words in error
    assert not out.exists()


def test_the_camera_best_surrounded_is_held_out_by_name(tmp_path: Path) -> None:
    asked = ExperimentOptions(tmp_path, capture=CaptureOptions(held_out=("auto",), frames=1))
    part, frames = capture_part(Path(CLIP), asked)
    assert (part.held_out, frames) == (("cam03",), 1)


def test_a_capture_that_holds_out_no_camera_cannot_be_scored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = bundled_clip()
    alike = WithRig(whole, whole.rig.with_held_out(frozenset()))
    monkeypatch.setattr(CapturePart, "open", lambda self: alike)
    for command in ("ablate", "compare"):
        error = error_of([command, CLIP, "-o", str(tmp_path / "out")], capsys, status=2)
        assert error == "structgstream: clip holds out no camera to score; name one with --held-out.\n"


@pytest.mark.parametrize("command", ["ablate", "compare"])
def test_ctrl_c_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def stopped(*_: object, **__: object) -> Outcome:
        raise KeyboardInterrupt

    monkeypatch.setattr("structgstream_studies.experiments.sweep.sweep", stopped)
    extra = ["--methods", "fast"] if command == "compare" else []
    error = error_of([command, CLIP, "-o", str(tmp_path), *SMALL, *extra], capsys, status=130)
    assert error == "\nInterrupted. Whole frames are stored; go on with the same command.\n"


def configs_asked(arguments: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, StreamConfig]:
    """What ``ablate`` would run, by key; nothing is."""
    asked: dict[str, StreamConfig] = {}

    def noted(tasks: Sequence[Task], *_: object, **__: object) -> Outcome:
        asked.update({task.key: task.config for task in tasks if isinstance(task, VariantRun)})
        return Outcome((), (), ())

    monkeypatch.setattr("structgstream_studies.experiments.sweep.sweep", noted)
    assert main(["ablate", CLIP, "-o", str(folder), *SMALL, *arguments]) == 0
    return asked


def test_tables_of_the_compact_stream_are_of_its_preset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--table", "distance", "effects", "rates", "--online.iterations", "7"]
    asked = configs_asked(arguments, tmp_path, monkeypatch)
    assert asked["compact"] == with_iterations(PRESETS["compact"], 7)
    assert asked["full"] == with_iterations(PRESETS["rig"], 7)
    assert asked["quality-p2"].online.rounding.quality == 2.0
    assert asked["without-distance"].codec == "raw"
    assert "Effects" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"distance.md", "effects.md", "rates.md"}


def test_the_paper_alone_is_the_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = configs_asked([], tmp_path, monkeypatch)
    assert asked["full"] == PRESETS["rig"]
    assert not [key for key in asked if key.startswith(("compact", "quality"))]


def test_another_full_method_of_the_compact_tables_must_be_compact(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = error_of(["ablate", CLIP, "-o", str(tmp_path), "--table", "rates", "--preset", "motion"], capsys, status=1)
    assert "need codec 'compact', got 'raw'; take --preset compact." in error


def test_failed_steps_are_named_with_those_that_were_not_begun(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = Outcome(failed=("first-1.seed0",), blocked=("full.seed0", "held.seed0"), skipped=())
    monkeypatch.setattr("structgstream_studies.experiments.sweep.sweep", lambda *_, **__: outcome)
    error = error_of(ablate(tmp_path), capsys, status=1)
    assert "1 of 8 steps failed (first-1.seed0), and 2 that needed them were not begun." in error
    assert f"{tmp_path / 'logs' / 'first-1.seed0.txt'}; the same command goes on" in error


def test_progress_off_a_terminal_is_a_line_for_each_step(capsys: pytest.CaptureFixture[str]) -> None:
    with Display(Console(width=80)) as view:
        view.show(Progress({"full.seed0": (0, 3)}, 1, 4, ()))
        view.show(Progress({"full.seed0": (2, 3)}, 1, 4, ()))
        view.show(Progress({"held.seed0": (0, 3)}, 2, 4, ("full.seed0",)))
    assert capsys.readouterr().out.splitlines() == [
        "1 of 4 steps done; begins full.seed0",
        "2 of 4 steps done, failed: full.seed0; begins held.seed0",
    ]


def test_a_wide_sheet_is_printed_in_parts_that_fit(capsys: pytest.CaptureFixture[str]) -> None:
    heads = [f"score {i}" for i in range(9)]
    rows = [[f"row {j}", *(f"{i}.{j}" for i in range(9))] for j in range(2)]
    print_sheet(Sheet("Scores [of] rows", ["name", *heads], rows), Console(width=80))
    text = capsys.readouterr().out
    assert max(len(line) for line in text.splitlines()) <= 80
    assert all(text.count(head) == 1 for head in heads)
    assert all(f"{i}.{j}" in text for i in range(9) for j in range(2))
    assert text.count("row 0") == text.count("row 1") == 3
    assert text.count("Scores [of]") == 3
    assert text.count("continued") == 2


def test_only_the_rows_asked_for_are_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["--table", "free", "effects", "--rows", "compact", "uniform-spawn"]
    assert configs_asked(arguments, tmp_path, monkeypatch).keys() == {"compact", "uniform-spawn"}


def test_a_row_of_no_table_is_an_error_that_lists_the_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = error_of(["ablate", CLIP, "-o", str(tmp_path), "--rows", "full", "bare"], capsys, status=1)
    assert "--rows bare: the tables have the rows without-scaling-factor, " in error
