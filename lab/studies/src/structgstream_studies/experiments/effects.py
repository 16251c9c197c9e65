# SPDX-License-Identifier: Apache-2.0
"""The effect of each part of the compact stream: the whole preset, and variants with one switch changed."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

from structgstream.errors import ConfigError
from structgstream.scene.state import FieldName
from structgstream.session.presets import StreamConfig
from structgstream.training.frame0.regularizers import PerturbationConfig
from structgstream.training.losses import LossWeights
from structgstream.training.online.config import MotionConfig, OnlineConfig
from structgstream.training.parameters import RoundingConfig
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import SCORES, Sheet, format_score
from structgstream_studies.experiments.summary import Summary, summaries
from structgstream_studies.experiments.variants import FULL, Variant

EFFECTS_TABLE = "effects"
WHOLE = "compact"
"""Key of the compact stream with everything, as ``structgstream compare`` calls it."""
BETTER_FIRST = "paper-better-first"
"""Key of paper mode with the compact stream's frame 0."""
DISTURBANCE_FIELDS = tuple(f"initial.perturbation.{name}" for name in ("dropped_share", "noise_scales"))
LOSS_FIELDS = ("initial.losses.l1", "initial.losses.ssim")
OFFSET_FIELDS, PAPER_OFFSETS = ("initial.offsets_per_anchor", "initial.all_drawn"), 5
CARRIED_SHARE, EASED, OTHER_RANK = 0.4, 0.5, 8
"""Values of switches that are off in the whole preset."""
PAPER_ITERATIONS = 100

_COLUMNS = (
    ("psnr_changed", "psnr_changed"),
    ("psnr_still", "psnr_still"),
    ("drift_db_per_frame", "drift_db_per_frame"),
    ("online_bytes", "online_kilobytes"),
    ("bytes_with_header", "kilobytes_with_header"),
    ("flicker", "flicker"),
    ("e_warp", "e_warp"),
    ("online_cpu_seconds", "online_cpu_seconds"),
    ("decode_and_render_fps", "decode_and_render_fps"),
)
"""Scores beside PSNR, and how each is written."""


def effects(full: StreamConfig, *, paper: StreamConfig) -> dict[str, Variant]:
    """The rows of the table, by key.

    Args:
        full: the compact stream with everything.
        paper: paper mode, with the key :data:`~structgstream_studies.experiments.variants.FULL`.

    Raises:
        ConfigError: ``full`` is no compact stream.
    """
    require_compact(full)
    rows = _Rows(full)
    rows.add(Variant(FULL, "paper mode", paper))
    rows.add(Variant(WHOLE, "compact, with everything", full))
    rows.add(Variant(BETTER_FIRST, "paper mode on compact's frame 0", _with_first_of(paper, full)))
    _of_frame_0(rows)
    _of_the_gate(rows)
    _of_coding(rows)
    _of_iterations(rows)
    _of_the_start(rows)
    _of_free_gaussians(rows)
    _of_the_light(rows)
    return rows.found


class _Rows:
    """Collects the rows of the table.

    Args:
        full: what each of them changes.
    """

    def __init__(self, full: StreamConfig) -> None:
        self.full, self.whole = full, full.online
        self.found: dict[str, Variant] = {}

    def add(self, row: Variant) -> None:
        self.found[row.key] = row

    def row(self, key: str, title: str, config: StreamConfig, *changes: str) -> None:
        """A change of any field."""
        self.add(Variant(f"{WHOLE}-{key}", title, config, frozenset(changes)))

    def online(self, key: str, title: str, config: OnlineConfig, *changes: str) -> None:
        """A change of later frames."""
        self.row(key, title, replace(self.full, online=config), *(f"online.{change}" for change in changes))

    def dynamic(self, key: str, title: str, fields: frozenset[FieldName]) -> None:
        """A change of the fields that frames change."""
        self.online(key, title, replace(self.whole, dynamic=fields), "dynamic")

    def priced(self, key: str, title: str, rounding: RoundingConfig, change: str) -> None:
        """A change of quantization and its price."""
        self.online(key, title, replace(self.whole, rounding=rounding), f"rounding.{change}")

    def gated(self, key: str, title: str, motion: MotionConfig, change: str) -> None:
        """A change of the gate."""
        self.online(key, title, replace(self.whole, motion=motion), f"motion.{change}")


def _of_frame_0(rows: _Rows) -> None:
    full = rows.full
    calm = replace(full, initial=replace(full.initial, perturbation=PerturbationConfig()))
    rows.row("without-disturbance", "frame 0 w/o dropout and perturbation", calm, *DISTURBANCE_FIELDS)
    paper = LossWeights()
    losses = replace(full.initial.losses, l1=paper.l1, ssim=paper.ssim)
    absolute = replace(full, initial=replace(full.initial, losses=losses))
    rows.row("paper-losses", "frame 0 by the paper's weights of L1 and SSIM", absolute, *LOSS_FIELDS)
    lively = replace(full, initial=replace(full.initial, offsets_per_anchor=PAPER_OFFSETS, all_drawn=False))
    title = f"{PAPER_OFFSETS} Gaussians an anchor, of which about half are never drawn"
    rows.row("offsets", title, lively, *OFFSET_FIELDS)


def _with_first_of(config: StreamConfig, full: StreamConfig) -> StreamConfig:
    """``config`` with the frame 0 of ``full``."""
    return replace(config, initial=full.initial, denoising=full.denoising)


def _of_the_gate(rows: _Rows) -> None:
    motion = rows.whole.motion
    rows.gated("without-gate", "w/o change gate", replace(motion, enabled=False), "enabled")
    eased = EASED if motion.hysteresis == 1.0 else 1.0
    title = "hysteresis of the gate" if eased != 1.0 else "w/o hysteresis of the gate"
    rows.gated("memory", title, replace(motion, hysteresis=eased), "hysteresis")
    carried = CARRIED_SHARE if motion.occluded_share == 0.0 else 0.0
    title = "hidden anchors are carried along" if carried else "hidden anchors stay behind"
    rows.gated("carrying", title, replace(motion, occluded_share=carried), "occluded_share")


def _of_coding(rows: _Rows) -> None:
    whole = rows.whole
    rows.priced("without-rate", "w/o rate penalty", replace(whole.rounding, rate_weight=0.0), "rate_weight")
    rows.dynamic("without-appearance", "w/o appearance", whole.dynamic.difference(["appearance"]))
    rank = replace(whole, appearance_rank=OTHER_RANK)
    rows.online(f"rank-{OTHER_RANK}", f"appearance in {OTHER_RANK} directions", rank, "appearance_rank")
    rows.dynamic("without-base-scales", "base scales held", whole.dynamic.difference(["base_scales"]))
    prior = 0.0 if whole.motion_prior else 1.0
    title = "with motion prior" if prior else "w/o motion prior"
    rows.online("motion-prior", title, replace(whole, motion_prior=prior), "motion_prior")
    incoherent = replace(whole, smoothness=replace(whole.smoothness, weight=0.0))
    rows.online("without-coherence", "w/o price of incoherent motion", incoherent, "smoothness.weight")


def _of_iterations(rows: _Rows) -> None:
    whole = rows.whole
    patching = replace(whole.patching, iteration=PAPER_ITERATIONS // 2)
    paced = replace(whole, iterations=PAPER_ITERATIONS, patching=patching)
    title = f"{PAPER_ITERATIONS} iterations in a frame"
    rows.online("more-iterations", title, paced, "iterations", "patching.iteration")


def _of_the_start(rows: _Rows) -> None:
    whole, start = rows.whole, rows.whole.scene_flow
    off, single = replace(start, enabled=False), replace(start, rounds=1)
    rows.online("without-start", "w/o motion start", replace(whole, scene_flow=off), "scene_flow.enabled")
    rows.online("one-round", "motion start in one round", replace(whole, scene_flow=single), "scene_flow.rounds")
    motion = replace(whole.motion, residual_threshold=0.0)
    rows.gated("without-residuals", "gate w/o residuals", motion, "residual_threshold")


def _of_free_gaussians(rows: _Rows) -> None:
    whole, patching = rows.whole, rows.whole.patching
    spawn = "gradient" if patching.spawn == "off" else "off"
    title = "births by gradients too" if spawn == "gradient" else "w/o births by gradients"
    rows.online("gradient-births", title, replace(whole, patching=replace(patching, spawn=spawn)), "patching.spawn")
    births = replace(whole.spawn, enabled=False)
    none = replace(whole, spawn=births, patching=replace(patching, spawn="off"))
    rows.online("without-free", "w/o free 3DGs", none, "spawn.enabled", "patching.spawn")
    large = replace(whole.spawn, thin=replace(whole.spawn.thin, enabled=False))
    rows.online("without-thin-births", "w/o births of thin content", replace(whole, spawn=large), "spawn.thin.enabled")
    rows.priced("free-unpriced", "free 3DGs not priced", replace(whole.rounding, free_priced=False), "free_priced")


def _of_the_light(rows: _Rows) -> None:
    whole = rows.whole
    dark = replace(
        whole, exposure=replace(whole.exposure, enabled=False), dynamic=whole.dynamic.difference(["color_mlp"])
    )
    rows.online("without-light", "global light not followed", dark, "exposure.enabled", "dynamic")


def require_compact(config: StreamConfig) -> None:
    """Check that a configuration's codec is ``compact``.

    Raises:
        ConfigError: it is not.
    """
    if config.codec != "compact":
        raise ConfigError(
            f"The tables of the compact stream need codec 'compact', got {config.codec!r}; take --preset compact."
        )


def effects_sheet(results: Iterable[Result], *, titles: Mapping[str, str], title: str = "Effects") -> Sheet:
    """Every row with its difference to the whole, seed by seed; rows without a result have dashes.

    Args:
        results: of one capture.
        titles: of the rows, in their order.
        title: of the table.
    """
    found = summaries(result for result in results if result.key in titles)
    whole = found.get(WHOLE)
    heads = ["variant", "seeds", SCORES["psnr"].title, SCORES["psnr_camera_color"].title, "to compact, dB"]
    columns = [*heads, *(SCORES[name].title for _, name in _COLUMNS)]
    return Sheet(title, columns, [[row, *_cells(found.get(key), whole)] for key, row in titles.items()])


def _cells(summary: Summary | None, whole: Summary | None) -> list[str]:
    if summary is None:
        return ["-"] * (4 + len(_COLUMNS))
    difference = None if whole is None or summary.key == WHOLE else summary.difference(whole, "psnr")
    cells = [
        str(len(summary.results)),
        format_score(summary.score("psnr"), "psnr"),
        format_score(summary.score("psnr_camera_color"), "psnr_camera_color"),
        format_score(difference, "psnr", signed=True),
    ]
    return cells + [format_score(summary.score(score), name) for score, name in _COLUMNS]
