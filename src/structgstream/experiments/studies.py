# SPDX-License-Identifier: Apache-2.0
"""The two questions that experiments answer: what each part of the method is worth, and how it stands beside others."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from structgstream.errors import ConfigError
from structgstream.experiments.captures import CapturePart
from structgstream.experiments.figures import Picture, write_comparison, write_curves, write_details
from structgstream.experiments.peer_runs import PEER_TITLES, PeerRun
from structgstream.experiments.readings import READINGS, readings_sheet
from structgstream.experiments.results import Result, read_result
from structgstream.experiments.sheets import Sheet, ablation_sheet, comparison_sheet, markdown
from structgstream.experiments.sweep import unique
from structgstream.experiments.tasks import Variation
from structgstream.experiments.variants import FULL, TABLES, variants
from structgstream.experiments.worker import Task
from structgstream.presets import DEFAULT_PRESET, PRESETS, StreamConfig

if TYPE_CHECKING:
    from structgstream.kernels.backend import Backend

READINGS_TABLE = "readings"
COMPARED = (
    "psnr_first", "psnr", "ssim", "ms_ssim", "lpips_alex", "flip", "psnr_changed", "psnr_still", "drift_db_per_frame",
    "online_bytes", "online_cpu_seconds", "first_cpu_seconds", "e_warp", "t_lpips", "temporal_flip",
    "flicker",
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
) -> list[Variation]:
    """Every variant of the tables (keys of ``variants.TABLES``, and ``readings``) with every seed, seed by seed.

    Raises:
        ConfigError: there is no such table.
    """
    for name in tables:
        if name not in TABLES and name != READINGS_TABLE:
            raise ConfigError(f"There is no table {name!r}; there are {', '.join(TABLES)} and {READINGS_TABLE}.")
    runs = []
    for seed in seeds:
        seeded = replace(full, seed=seed)
        configs = {key: variant.config for key, variant in variants(seeded).items()}
        configs |= {key: reading.edit(seeded) for key, reading in READINGS.items()}
        keys = dict.fromkeys(key for name in tables for key in rows_of(name))
        runs += [Variation(key, capture, configs[key], folder, frames) for key in keys]
    return runs


def rows_of(table: str) -> list[str]:
    """Keys of the runs of a table."""
    return list(READINGS if table == READINGS_TABLE else TABLES[table].rows)


def comparison_runs(
    methods: Sequence[str],
    capture: CapturePart,
    *,
    frames: int,
    alone_every: int,
    seeds: Sequence[int],
    folder: Path,
) -> list[Variation | PeerRun]:
    """Every method with every seed.

    Args:
        methods: presets, ``held`` (frame 0 for ever, after the default preset) and peers by name.
        capture: which pictures.
        frames: number of frames of ``capture``.
        alone_every: methods that fit each frame alone do so for every so many-th frame.
        seeds: of frame 0.
        folder: where everything goes.

    Raises:
        ConfigError: there is no such method.
    """
    known = method_titles()
    runs: list[Variation | PeerRun] = []
    for seed in seeds:
        for name in methods:
            if name not in known:
                raise ConfigError(f"There is no method {name!r}; there are {', '.join(known)}.")
            if name in PRESETS or name == "held":
                config = replace(PRESETS[DEFAULT_PRESET if name == "held" else name], seed=seed)
                variant = variants(config)["held" if name == "held" else FULL]
                runs.append(Variation(method_key(name), capture, variant.config, folder, frames))
            else:
                part = replace(capture, every=alone_every) if fits_frames_alone(name) else capture
                runs.append(PeerRun(name, part, seed, folder, -(-frames // part.every)))
    return runs


def method_key(name: str) -> str:
    """The key of a method's results: the default preset's is the full method of the ablations."""
    return FULL if name == DEFAULT_PRESET else name


def method_titles() -> dict[str, str]:
    """Every method that can be compared, with its name in tables."""
    return {name: f"Struct-GStream ({name})" for name in PRESETS} | {"held": "frame 0 held"} | dict(PEER_TITLES)


def fits_frames_alone(name: str) -> bool:
    """Whether a peer begins anew with every frame."""
    from structgstream.peers.methods import METHODS

    return name in METHODS and METHODS[name].stands_alone


def needed(runs: Iterable[Variation | PeerRun]) -> list[Task]:
    """The runs with what comes before them, each once, in an order in which they can be done."""
    tasks: list[Task] = []
    for run in runs:
        if isinstance(run, Variation) and run.needs:
            tasks.append(run.first)
        tasks.append(run)
    return unique(tasks)


def results_of(runs: Iterable[Variation | PeerRun]) -> list[Result]:
    """The results that are there.

    Raises:
        StorageError: one cannot be read.
    """
    return [found for run in runs if (found := read_result(run.result)) is not None]


def write_ablation(folder: Path, table: str, runs: Sequence[Variation], *, backend: "Backend") -> Sheet:
    """The table of one ablation, and in ``folder`` ``TABLE.md``, ``TABLE-curves.png`` and ``TABLE-detail.png``."""
    titles = variant_titles() | {key: f"{one.question}: {one.answer}" for key, one in READINGS.items()}
    rows = rows_of(table)
    mine = [run for run in runs if run.key in rows]
    results = results_of(mine)
    readings = table == READINGS_TABLE
    sheet = readings_sheet(results) if readings else ablation_sheet(TABLES[table], results, titles=titles)
    _write_sheet(folder / f"{table}.md", sheet)
    if results:
        write_curves(folder / f"{table}-curves.png", results, keys=rows, titles=titles)
        _write_details(folder / f"{table}-detail.png", mine, titles=titles, backend=backend)
    return sheet


def write_methods(folder: Path, runs: Sequence[Variation | PeerRun], *, backend: "Backend") -> Sheet:
    """The comparison, and in ``folder`` ``methods.md``, ``methods.png`` and ``methods-detail.png``."""
    titles = {method_key(name): title for name, title in method_titles().items()}
    results = results_of(runs)
    sheet = comparison_sheet(results, titles=titles, scores=COMPARED)
    _write_sheet(folder / "methods.md", sheet)
    if results:
        write_comparison(folder / "methods.png", results, titles=titles)
        _write_details(folder / "methods-detail.png", runs, titles=titles, backend=backend)
    return sheet


def variant_titles() -> dict[str, str]:
    """Every variant's name in tables."""
    return {key: variant.title for key, variant in variants(PRESETS[DEFAULT_PRESET]).items()}


def _write_sheet(path: Path, sheet: Sheet) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"# {sheet.title}\n\n{markdown(sheet)}")


def _write_details(
    path: Path, runs: Sequence[Variation | PeerRun], *, titles: Mapping[str, str], backend: "Backend"
) -> None:
    """Each run's picture, at the first held-out camera, of the frame in which the runs of one seed differ most."""
    from structgstream.data.wrappers import of_cameras
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
        return max(values) - min(values)

    index = max(range(0, len(source), every), key=spread)
    truth = next(of_cameras(source, (camera,)).frames(index)).images[camera]
    pictures: dict[str, Picture] = {}
    for run in results:
        recording = run.recording()
        view = recording.header.similarity.camera(recording.header.rig[camera])
        _, scene = next(iter(recording.scenes(index // run.capture.every)))
        pictures[titles[run.key]] = rendered(scene, view, backend)[0]
    write_details(path, pictures, truth, title=f"{source.name}, camera {camera}, frame {index}")
