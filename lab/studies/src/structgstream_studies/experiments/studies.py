# SPDX-License-Identifier: Apache-2.0
"""The two kinds of studies: ablations of the method, and comparisons with other methods."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from structgstream.errors import ConfigError
from structgstream.session.presets import PAPER_DATA, PAPER_METHOD_PRESET, PRESETS, StreamConfig
from structgstream_studies.experiments.captures import CapturePart
from structgstream_studies.experiments.effects import EFFECTS_TABLE, effects, effects_sheet
from structgstream_studies.experiments.figures import (
    Picture,
    write_adjacent,
    write_comparison,
    write_curves,
    write_details,
)
from structgstream_studies.experiments.peer_runs import PEER_TITLES, PeerRun
from structgstream_studies.experiments.rate_distortion import (
    QUALITIES,
    RATES_TABLE,
    bullet_list,
    curve_titles,
    qualities,
    quality_key,
    rates_sheet,
    versus_sheet,
)
from structgstream_studies.experiments.rate_figures import write_rates
from structgstream_studies.experiments.readings import READINGS, readings_sheet
from structgstream_studies.experiments.results import Result, read_result, read_results
from structgstream_studies.experiments.sheets import Sheet, ablation_sheet, comparison_sheet, markdown
from structgstream_studies.experiments.sweep import unique
from structgstream_studies.experiments.tasks import VariantRun
from structgstream_studies.experiments.variants import FULL, TABLES, variants
from structgstream_studies.experiments.worker import Task

if TYPE_CHECKING:
    from structgstream.kernels.backend import Backend

READINGS_TABLE = "readings"
COMPACT_TABLES = (EFFECTS_TABLE, RATES_TABLE)
"""Tables of the compact stream."""
COMPACT_PRESET = "compact"
ADJACENT = 3
"""Number of consecutive frames in the picture of methods side by side."""
COMPARED = (
    "psnr_first", "psnr", "psnr_camera_color", "ssim", "ms_ssim", "lpips_alex", "flip", "psnr_changed", "psnr_still",
    "drift_db_per_frame", "online_bytes", "bytes_with_header", "online_cpu_seconds", "first_cpu_seconds",
    "decode_and_render_fps", "e_warp", "t_lpips", "temporal_flip", "flicker",
)  # fmt: skip
"""Columns of the comparison, those without a value left out."""


def ablation_runs(
    tables: Sequence[str],
    full: StreamConfig,
    capture: CapturePart,
    *,
    frames: int,
    seeds: Sequence[int],
    folder: Path,
    paper: StreamConfig = PRESETS[PAPER_METHOD_PRESET],
    rows: Sequence[str] = (),
) -> list[VariantRun]:
    """Every variant of the tables with every seed, seed by seed.

    Args:
        tables: keys of ``variants.TABLES``, ``readings``, and of :data:`COMPACT_TABLES`.
        full: the configuration that the variants edit.
        capture: the pictures.
        frames: number of frames of ``capture``.
        seeds: random seeds.
        folder: the output folder.
        paper: paper mode, a row of the table of effects.
        rows: keys of the variants to run; all if empty.

    Raises:
        ConfigError: there is no such table, or it is one of the compact stream and ``full`` is none.
    """
    known = [*TABLES, READINGS_TABLE, *COMPACT_TABLES]
    for name in tables:
        if name not in known:
            raise ConfigError(f"There is no table {name!r}; there are {', '.join(known)}.")
    runs = []
    for seed in seeds:
        configs = _configs(tables, replace(full, seed=seed), replace(paper, seed=seed))
        keys = dict.fromkeys(key for name in tables for key in rows_of(name))
        runs += [VariantRun(key, capture, configs[key], folder, frames) for key in keys if not rows or key in rows]
    return runs


def _configs(tables: Sequence[str], full: StreamConfig, paper: StreamConfig) -> dict[str, StreamConfig]:
    configs = {key: reading.edit(full) for key, reading in READINGS.items()}
    found = variants(full)
    if EFFECTS_TABLE in tables:
        found |= effects(full, paper=paper)
    if RATES_TABLE in tables:
        found |= qualities(full)
    return configs | {key: variant.config for key, variant in found.items()}


def rows_of(table: str) -> list[str]:
    """Keys of the runs of a table."""
    if table == EFFECTS_TABLE:
        return list(effect_titles())
    if table == RATES_TABLE:
        return [quality_key(quality) for quality in QUALITIES]
    return list(READINGS if table == READINGS_TABLE else TABLES[table].rows)


def comparison_runs(
    methods: Sequence[str],
    capture: CapturePart,
    *,
    frames: int,
    alone_every: int,
    seeds: Sequence[int],
    folder: Path,
) -> list[VariantRun | PeerRun]:
    """Every method with every seed.

    Args:
        methods: presets, ``held`` (frame 0 for ever, after paper mode) and peers by name.
        capture: which pictures.
        frames: number of frames of ``capture``.
        alone_every: methods that fit each frame alone do so for every so many-th frame.
        seeds: of frame 0.
        folder: where everything goes.

    Raises:
        ConfigError: there is no such method.
    """
    known = method_titles()
    runs: list[VariantRun | PeerRun] = []
    for seed in seeds:
        for name in methods:
            if name not in known:
                raise ConfigError(f"There is no method {name!r}; there are {', '.join(known)}.")
            if name in PRESETS or name == "held":
                config = replace(PRESETS[PAPER_METHOD_PRESET if name == "held" else name], seed=seed)
                variant = variants(config)["held" if name == "held" else FULL]
                runs.append(VariantRun(method_key(name), capture, variant.config, folder, frames))
            else:
                part = replace(capture, every=alone_every) if fits_frames_alone(name) else capture
                runs.append(PeerRun(name, part, seed, folder, -(-frames // part.every)))
    return runs


def method_key(name: str) -> str:
    """The key of a method's results: paper mode is the full method of the ablations."""
    return FULL if name == PAPER_METHOD_PRESET else name


def method_titles() -> dict[str, str]:
    """Every method that can be compared, with its name in tables."""
    ours = {name: f"Struct-GStream ({name})" for name in PRESETS}
    ours |= {name: f"Struct-GStream, the paper's preset ({name})" for name in PAPER_DATA}
    return ours | {"held": "frame 0 held"} | dict(PEER_TITLES)


def fits_frames_alone(name: str) -> bool:
    """Whether a peer begins anew with every frame."""
    from structgstream_studies.peers.methods import METHODS

    return name in METHODS and METHODS[name].stands_alone


def with_dependencies(runs: Iterable[VariantRun | PeerRun]) -> list[Task]:
    """The runs with what comes before them, each once, in an order in which they can be done."""
    tasks: list[Task] = []
    for run in runs:
        if isinstance(run, VariantRun) and run.needs:
            tasks.append(run.first)
        tasks.append(run)
    return unique(tasks)


def results_of(runs: Iterable[VariantRun | PeerRun]) -> list[Result]:
    """The results that are there.

    Raises:
        StorageError: one cannot be read.
    """
    return [found for run in runs if (found := read_result(run.result)) is not None]


def write_ablation(folder: Path, table: str, runs: Sequence[VariantRun], *, backend: "Backend") -> list[Sheet]:
    """The tables of one ablation, and in ``folder`` ``TABLE.md``, ``TABLE-curves.png`` and ``TABLE-detail.png``.

    Of the rates there is ``rates.png`` too, beside whatever else the folder has results of.
    """
    titles, rows = _titles(table), rows_of(table)
    mine = [run for run in runs if run.key in rows]
    results = results_of(mine)
    if table == RATES_TABLE:
        around = read_results(folder / "results")
        versus, remarks = versus_sheet(around)
        sheets = [rates_sheet(around), versus]
        _write_sheets(folder / "rates.md", sheets, remarks)
        if results:
            write_rates(folder / "rates.png", around)
    else:
        sheets, remarks = [_ablation_sheet(table, results)], []
        _write_sheets(folder / f"{table}.md", sheets)
    if results:
        write_curves(folder / f"{table}-curves.png", results, keys=rows, titles=titles)
        _write_details(folder / f"{table}-detail.png", mine, titles=titles, backend=backend)
    return sheets


def _titles(table: str) -> dict[str, str]:
    if table == READINGS_TABLE:
        return {key: f"{one.question}: {one.answer}" for key, one in READINGS.items()}
    of_compact = {EFFECTS_TABLE: effect_titles, RATES_TABLE: curve_titles}
    return of_compact.get(table, variant_titles)()


def _ablation_sheet(table: str, results: Sequence[Result]) -> Sheet:
    if table == READINGS_TABLE:
        return readings_sheet(results)
    if table == EFFECTS_TABLE:
        return effects_sheet(results, titles=effect_titles())
    return ablation_sheet(TABLES[table], results, titles=variant_titles())


def write_methods(folder: Path, runs: Sequence[VariantRun | PeerRun], *, backend: "Backend") -> Sheet:
    """The comparison, and in ``folder`` ``methods.md``, ``methods.png``, ``methods-detail.png`` and
    ``methods-adjacent.png``."""
    titles = {method_key(name): title for name, title in method_titles().items()}
    results = results_of(runs)
    sheet = comparison_sheet(results, titles=titles, scores=COMPARED)
    _write_sheets(folder / "methods.md", [sheet])
    if results:
        write_comparison(folder / "methods.png", results, titles=titles)
        _write_details(folder / "methods-detail.png", runs, titles=titles, backend=backend)
        _write_adjacent(folder / "methods-adjacent.png", runs, titles=titles, backend=backend)
    return sheet


def variant_titles() -> dict[str, str]:
    """Every variant's name in tables."""
    return {key: variant.title for key, variant in variants(PRESETS[PAPER_METHOD_PRESET]).items()}


def effect_titles() -> dict[str, str]:
    """The rows of the table of effects, in its order."""
    found = effects(PRESETS[COMPACT_PRESET], paper=PRESETS[PAPER_METHOD_PRESET])
    return {key: variant.title for key, variant in found.items()}


def _write_sheets(path: Path, sheets: Sequence[Sheet], remarks: Sequence[str] = ()) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(f"# {sheet.title}\n\n{markdown(sheet)}" for sheet in sheets) + bullet_list(remarks))


def _write_details(
    path: Path, runs: Sequence[VariantRun | PeerRun], *, titles: Mapping[str, str], backend: "Backend"
) -> None:
    """Each run's picture, at the first held-out camera, of the frame in which the runs of one seed differ most."""
    from structgstream.data.source import select_cameras
    from structgstream.evaluation.evaluate import rendered

    results = {run: found for run in runs if (found := read_result(run.result)) is not None}
    seed = next(iter(results)).seed
    results = {run: found for run, found in results.items() if run.seed == seed}
    source = replace(next(iter(results)).capture, every=1).open()
    camera = source.rig.testing[0]
    # Some methods show every so many-th frame only: one that all of them have.
    every = max(run.capture.every for run in results)

    def spread(index: int) -> float:
        values = [found.frames[index // run.capture.every]["psnr"] for run, found in results.items()]
        return -1.0 if None in values else max(values) - min(values)  # absent cameras have no score

    index = max(range(0, len(source), every), key=spread)
    truth = next(select_cameras(source, (camera,)).frames(index)).images[camera]
    pictures: dict[str, Picture] = {}
    for run in results:
        recording = run.recording()
        view = recording.header.camera(camera)
        _, scene = next(iter(recording.scenes(index // run.capture.every)))
        pictures[titles[run.key]] = rendered(scene, view, backend)[0]
    write_details(path, pictures, truth, title=f"{source.name}, camera {camera}, frame {index}")


def _write_adjacent(
    path: Path, runs: Sequence[VariantRun | PeerRun], *, titles: Mapping[str, str], backend: "Backend"
) -> None:
    """Consecutive pictures of the methods that have all frames, at the first held-out camera, from the middle on; none
    if there are fewer than :data:`ADJACENT` frames."""
    from structgstream.data.source import select_cameras
    from structgstream.evaluation.evaluate import rendered

    found = [run for run in runs if run.capture.every == 1 and read_result(run.result) is not None]
    found = [run for run in found if run.seed == found[0].seed]
    if not found or min(run.frames for run in found) < ADJACENT:
        return
    source = found[0].capture.open()
    camera, first = source.rig.testing[0], (len(source) - ADJACENT) // 2
    taken = select_cameras(source, (camera,)).frames(first)
    truth = [frame.images[camera] for frame in islice(taken, ADJACENT)]
    pictures: dict[str, list[Picture]] = {}
    for run in found:
        recording = run.recording()
        view = recording.header.camera(camera)
        scenes = islice(recording.scenes(first), ADJACENT)
        pictures[titles[run.key]] = [rendered(scene, view, backend)[0] for _, scene in scenes]
    last = first + ADJACENT - 1
    write_adjacent(path, pictures, truth, title=f"{source.name}, camera {camera}, frames {first} to {last}")
