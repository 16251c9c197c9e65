# SPDX-License-Identifier: Apache-2.0
"""Which runs a study asks for, what comes before them, and what is left in its folder."""

from dataclasses import replace
from pathlib import Path

import pytest

from outcomes import outcome
from small_runs import CLIP, compact, quick
from structgstream.errors import ConfigError
from structgstream.kernels.backend import select_backend
from structgstream.session.presets import PRESETS
from structgstream_studies.experiments.readings import READINGS
from structgstream_studies.experiments.results import write_result
from structgstream_studies.experiments.studies import (
    COMPACT_TABLES,
    ablation_runs,
    comparison_runs,
    method_titles,
    results_of,
    rows_of,
    variant_titles,
    with_dependencies,
    write_ablation,
    write_methods,
)
from structgstream_studies.experiments.tasks import FirstFrameRun, VariantRun
from structgstream_studies.experiments.variants import FULL, TABLES

OWN_FRAME_0 = {
    FULL,
    "compact-without-perturbation",
    "compact-paper-losses",
    "compact-paper-offsets",
    "compact-single-picture",
    "compact-with-floaters",
}


def runs_of(*tables: str, folder: Path, seeds: tuple[int, ...] = (0, 1, 2)) -> list[VariantRun]:
    return ablation_runs(tables, quick(), CLIP, frames=3, seeds=seeds, folder=folder)


def test_every_row_is_run_with_every_seed_and_those_of_two_tables_once(tmp_path: Path) -> None:
    runs = runs_of("free", "patching", folder=tmp_path)
    rows = {*TABLES["free"].rows, *TABLES["patching"].rows}
    assert [run.seed for run in runs] == [0] * len(rows) + [1] * len(rows) + [2] * len(rows)
    assert len({run.name for run in runs}) == len(runs) == 3 * len(rows)
    assert {run.key for run in runs} == rows
    assert all(run.config.seed == run.seed for run in runs)
    free = next(run for run in runs if run.name == "without-free.seed2")
    assert free.config.online.patching.spawn == "off"
    assert free.config.initial == quick().initial


def test_variants_of_a_seed_wait_for_one_first_frame(tmp_path: Path) -> None:
    tasks = with_dependencies(runs_of("free", "distance", folder=tmp_path, seeds=(0, 1)))
    firsts = [task for task in tasks if isinstance(task, FirstFrameRun)]
    # Each seed has one for the variants that differ later, and one for each other reading of the regularisation.
    assert len(firsts) == 8
    before = set()
    for task in tasks:
        assert before.issuperset(task.needs)
        before.add(task.name)
    assert len(before) == len(tasks) == 8 + 2 * 9


def test_readings_are_edits_of_what_is_asked_for(tmp_path: Path) -> None:
    runs = {run.key: run for run in runs_of("readings", folder=tmp_path, seeds=(5,))}
    assert list(runs) == list(READINGS) == rows_of("readings")
    assert runs["reading-default"].config == quick(seed=5)
    assert runs["reading-l1"].config.initial.losses.l1 == 0.8


def test_unknown_tables_and_methods_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no table 'colours'; there are structured"):
        runs_of("colours", folder=tmp_path)
    with pytest.raises(ConfigError, match=r"no method 'nerf'; there are .*held.*3dgstream"):
        comparison_runs(["rig", "nerf"], CLIP, frames=3, alone_every=1, seeds=(0,), folder=tmp_path)


def test_the_papers_presets_are_methods_that_are_named_as_the_papers() -> None:
    assert method_titles()["paper-n3dv"] == "Struct-GStream, the paper's preset (paper-n3dv)"
    assert method_titles()["rig"] == "Struct-GStream (rig)"


def test_methods_are_presets_and_the_floor(tmp_path: Path) -> None:
    runs = comparison_runs(["rig", "fast", "held"], CLIP, frames=3, alone_every=2, seeds=(4,), folder=tmp_path)
    assert [run.key for run in runs] == [FULL, "fast", "held"]
    configs = [run.config for run in runs if isinstance(run, VariantRun)]
    assert configs[:2] == [replace(PRESETS[name], seed=4) for name in ("rig", "fast")]
    assert configs[2].online.iterations == 0
    assert configs[2].initial == configs[0].initial
    assert method_titles().keys() >= {*PRESETS, "held"}


def test_tables_of_the_compact_stream_share_its_runs(tmp_path: Path) -> None:
    paper = replace(quick(), initial=replace(quick().initial, voxel_size=0.5))
    runs = ablation_runs(
        ["effects", "rates"], compact(), CLIP, frames=3, seeds=(0, 3), folder=tmp_path, paper=paper
    )  # fmt: skip
    keys = [run.key for run in runs if run.seed == 3]
    assert set(keys) == {*rows_of("effects"), *rows_of("rates")}
    assert len(keys) == len(set(keys)) == len(rows_of("effects")) + len(rows_of("rates")) - 1
    configs = {run.key: run.config for run in runs if run.seed == 3}
    assert configs["compact"] == replace(compact(), seed=3)
    assert configs[FULL] == replace(paper, seed=3)
    assert configs["quality-m2"].online.rounding.quality == -2.0


def test_every_stream_of_a_seed_begins_with_one_frame_0(tmp_path: Path) -> None:
    """But for paper mode and the rows about frame 0."""
    runs = ablation_runs(
        ["effects", "rates"], compact(), CLIP, frames=3, seeds=(0,), folder=tmp_path, paper=quick()
    )  # fmt: skip
    assert len({run.first.name for run in runs if run.key not in OWN_FRAME_0}) == 1


@pytest.mark.parametrize("table", COMPACT_TABLES)
def test_tables_of_the_compact_stream_are_of_nothing_else(tmp_path: Path, table: str) -> None:
    with pytest.raises(ConfigError, match="take --preset compact"):
        runs_of(table, folder=tmp_path)


def test_rates_are_written_with_what_else_the_folder_has(tmp_path: Path) -> None:
    backend = select_backend("reference")
    runs = ablation_runs(["rates"], compact(), CLIP, frames=3, seeds=(0,), folder=tmp_path)
    write_result(tmp_path / "results" / "paper.json", outcome(FULL, psnr=31.25, mean={"online_bytes": 1.5e6}))
    points, versus = write_ablation(tmp_path, "rates", runs, backend=backend)
    assert [row[0] for row in points.rows][-1] == "paper mode"
    assert versus.rows == []
    text = (tmp_path / "rates.md").read_text()
    assert "| paper mode | 1 | 31.25 | - | - | 1500.0 | 360.00 | - | - | - |" in text
    (effects,) = write_ablation(tmp_path, "effects", [], backend=backend)
    assert (tmp_path / "effects.md").read_text().startswith(f"# {effects.title}\n\n| variant |")


def test_results_are_those_that_are_there(tmp_path: Path) -> None:
    runs = runs_of("free", folder=tmp_path, seeds=(0,))
    write_result(runs[1].result, outcome(runs[1].key))
    assert [result.key for result in results_of(runs)] == [runs[1].key]


def test_a_table_of_no_result_is_written_without_pictures(tmp_path: Path) -> None:
    backend = select_backend("reference")
    runs = runs_of("structured", folder=tmp_path)
    (sheet,) = write_ablation(tmp_path / "out", "structured", runs, backend=backend)
    assert (tmp_path / "out" / "structured.md").read_text().startswith(f"# {sheet.title}\n\n| variant |")
    assert write_methods(tmp_path / "out", [], backend=backend).rows == []
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"structured.md", "methods.md"}


def test_every_row_and_every_method_has_a_title_of_its_own() -> None:
    titles = variant_titles()
    assert all(key in titles for table in TABLES.values() for key in table.rows)
    assert len(set(titles.values())) == len(titles)
    assert len(set(method_titles().values())) == len(method_titles())
