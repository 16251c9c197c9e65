# SPDX-License-Identifier: Apache-2.0
"""The effect of each part of the compact stream: the whole preset, and variants without one part."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

from structgstream.errors import ConfigError
from structgstream.session.presets import PRESETS, StreamConfig
from structgstream.training.frame0.regularizers import PerturbationConfig
from structgstream.training.losses import LossWeights
from structgstream.training.online.config import OnlineConfig
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import SCORES, Sheet, format_score
from structgstream_studies.experiments.summary import Summary, summaries
from structgstream_studies.experiments.variants import FULL, Variant

EFFECTS_TABLE = "effects"
WHOLE = "compact"
"""Key of the compact stream with everything, as ``structgstream compare`` calls it."""
PAPER_ONLINE = "paper-online"
"""Key of the paper's online frames on the compact stream's frame 0."""
BARE = f"{WHOLE}-bare"
"""Key of the row without any part about what moves, emerges or is occluded."""

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
        ConfigError: ``full`` is no compact stream, or lacks a part already.
    """
    require_compact(full)
    rows = [
        Variant(WHOLE, "compact", full),
        Variant(FULL, "the paper's method (rig)", paper),
        Variant(
            PAPER_ONLINE,
            "the paper's online frames on compact's frame 0",
            replace(paper, initial=full.initial, denoising=full.denoising),
        ),
        *_of_frame_0(full),
        *_of_online_frames(full),
    ]
    for row in rows:
        if row.changes and row.config == full:
            raise ConfigError(
                f"The table {EFFECTS_TABLE} leaves out {min(row.changes)}, which is off already; take a configuration "
                "in which it is on."
            )
    return {row.key: row for row in rows}


def _of_frame_0(full: StreamConfig) -> list[Variant]:
    """Rows with a frame 0 of their own."""
    initial, paper = full.initial, LossWeights()

    def row(key: str, title: str, config: StreamConfig, *changes: str) -> Variant:
        return Variant(f"{WHOLE}-{key}", title, config, frozenset(changes))

    return [
        row(
            "without-perturbation",
            "frame 0 without dropout and perturbation",
            replace(full, initial=replace(initial, perturbation=PerturbationConfig())),
            "initial.perturbation.dropped_share",
            "initial.perturbation.noise_scales",
        ),
        row(
            "paper-losses",
            "frame 0 with the paper's weights of L1 and SSIM",
            replace(full, initial=replace(initial, losses=replace(initial.losses, l1=paper.l1, ssim=paper.ssim))),
            "initial.losses.l1",
            "initial.losses.ssim",
        ),
        row(
            "paper-offsets",
            "5 Gaussians an anchor, of which about half are never drawn",
            replace(
                full,
                initial=replace(initial, offsets_per_anchor=PRESETS["rig"].initial.offsets_per_anchor, all_drawn=False),
            ),
            "initial.offsets_per_anchor",
            "initial.all_drawn",
        ),
        row(
            "single-picture",
            "frame 0 of one picture a camera",
            replace(full, denoising=replace(full.denoising, frames=1)),
            "denoising.frames",
        ),
        row(
            "with-floaters",
            "floaters of frame 0 kept",
            replace(full, initial=replace(initial, floaters=replace(initial.floaters, enabled=False))),
            "initial.floaters.enabled",
        ),
    ]


def _of_online_frames(full: StreamConfig) -> list[Variant]:
    """Rows on the same frame 0."""
    online = full.online
    motion, rounding, flow = online.motion, online.rounding, online.scene_flow

    def row(key: str, title: str, config: OnlineConfig, *changes: str) -> Variant:
        paths = frozenset(f"online.{change}" for change in changes)
        return Variant(f"{WHOLE}-{key}", title, replace(full, online=config), paths)

    no_flow = replace(flow, enabled=False)
    no_spawn = replace(online.spawn, enabled=False)
    no_residuals = replace(motion, residual_threshold=0.0)
    occluded_static = replace(motion, occluded_share=0.0)
    no_smoothness = replace(online.smoothness, weight=0.0)
    bare = replace(
        online,
        scene_flow=no_flow,
        spawn=no_spawn,
        motion=replace(motion, residual_threshold=0.0, occluded_share=0.0),
        smoothness=no_smoothness,
        motion_prior=0.0,
    )
    no_thin = replace(online.spawn, thin=replace(online.spawn.thin, enabled=False))
    no_light = replace(
        online,
        exposure=replace(online.exposure, enabled=False),
        dynamic=online.dynamic.difference(["color_mlp"]),
    )
    return [
        row(
            "all-dynamic",
            "no selection: everything dynamic",
            replace(online, motion=replace(motion, enabled=False)),
            "motion.enabled",
        ),
        row(
            "without-hysteresis",
            "selection without hysteresis",
            replace(online, motion=replace(motion, hysteresis=1.0)),
            "motion.hysteresis",
        ),
        row(
            "without-residuals",
            "selection without residuals",
            replace(online, motion=no_residuals),
            "motion.residual_threshold",
        ),
        row(
            "occluded-static",
            "occluded anchors static",
            replace(online, motion=occluded_static),
            "motion.occluded_share",
        ),
        row(
            "without-rate-term",
            "no rate term",
            replace(online, rounding=replace(rounding, rate_weight=0.0)),
            "rounding.rate_weight",
        ),
        row(
            "without-free-rate-term",
            "no rate term of free Gaussians",
            replace(online, rounding=replace(rounding, free_priced=False)),
            "rounding.free_priced",
        ),
        row(
            "without-appearance",
            "no appearance",
            replace(online, dynamic=online.dynamic.difference(["appearance"])),
            "dynamic",
        ),
        row(
            "without-base-scales",
            "base scales static",
            replace(online, dynamic=online.dynamic.difference(["base_scales"])),
            "dynamic",
        ),
        row("without-smoothness", "no smoothness term", replace(online, smoothness=no_smoothness), "smoothness.weight"),
        row("without-motion-prior", "no motion prior", replace(online, motion_prior=0.0), "motion_prior"),
        row("without-scene-flow", "no scene flow", replace(online, scene_flow=no_flow), "scene_flow.enabled"),
        row(
            "one-round",
            "scene flow in one round",
            replace(online, scene_flow=replace(flow, rounds=1)),
            "scene_flow.rounds",
        ),
        row("without-spawn", "no free Gaussians", replace(online, spawn=no_spawn), "spawn.enabled"),
        row("without-thin-spawn", "no spawning of thin content", replace(online, spawn=no_thin), "spawn.thin.enabled"),
        row(
            "without-extra-iterations",
            "as many iterations however fast things move",
            replace(online, extra_iterations=0.0),
            "extra_iterations",
        ),
        row("without-light", "global light not followed", no_light, "exposure.enabled", "dynamic"),
        row(
            "bare",
            "no scene flow, spawning, residuals, occluded anchors, smoothness and prior",
            bare,
            "scene_flow.enabled",
            "spawn.enabled",
            "motion.residual_threshold",
            "motion.occluded_share",
            "smoothness.weight",
            "motion_prior",
        ),
    ]


def require_compact(config: StreamConfig) -> None:
    """Check that a configuration's codec is ``compact``.

    Raises:
        ConfigError: it is not.
    """
    if config.codec != "compact":
        raise ConfigError(
            f"The tables of the compact stream need codec 'compact', got {config.codec!r}; take --preset compact."
        )


def effects_sheet(results: Iterable[Result], *, titles: Mapping[str, str]) -> Sheet:
    """Every row that has results, with its difference to the whole, seed by seed.

    Args:
        results: of one capture.
        titles: of the rows, in their order.
    """
    found = summaries(result for result in results if result.key in titles)
    whole = found.get(WHOLE)
    heads = ["variant", "seeds", SCORES["psnr"].title, SCORES["psnr_camera_color"].title, "to compact, dB"]
    columns = [*heads, *(SCORES[name].title for _, name in _COLUMNS)]
    return Sheet("Effects", columns, [[row, *_cells(found[key], whole)] for key, row in titles.items() if key in found])


def _cells(summary: Summary, whole: Summary | None) -> list[str]:
    difference = None if whole is None or summary.key == WHOLE else summary.difference(whole, "psnr")
    cells = [
        str(len(summary.results)),
        format_score(summary.score("psnr"), "psnr"),
        format_score(summary.score("psnr_camera_color"), "psnr_camera_color"),
        format_score(difference, "psnr", signed=True),
    ]
    return cells + [format_score(summary.score(score), name) for score, name in _COLUMNS]
