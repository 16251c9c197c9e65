# SPDX-License-Identifier: Apache-2.0
"""The paper's ablations as values: each variant is an edit of the full configuration, with the names of its fields.

The paper's figures (tables "Ablation study of structured 3DGs", "... of free 3DG generation and pruning", "... of the
Global Patching Strategy") were measured on scenes of another capture, so only the order of the variants can be
compared, not the values.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from structgstream.scene.state import FieldName
from structgstream.session.presets import PAPER, PRESETS, StreamConfig
from structgstream.training.online.config import OnlineConfig, PatchingConfig

PaperFigures = Mapping[str, float]


@dataclass(frozen=True)
class Variant:
    """One configuration of the method.

    Args:
        key: its name in commands, files and results.
        title: its name in tables.
        config: the whole configuration.
        changes: the paths of exactly the fields in which it differs from the full one (tested).
    """

    key: str
    title: str
    config: StreamConfig
    changes: frozenset[str] = frozenset()


@dataclass(frozen=True)
class AblationTable:
    """One table of the paper.

    Args:
        key: its name in commands.
        title: its subject.
        scene: the scene on which the paper measured it.
        rows: variants in the paper's order, each with the paper's figures by score (empty where it prints none).
        claim: what the paper concludes from it.
    """

    key: str
    title: str
    scene: str
    rows: Mapping[str, PaperFigures]
    claim: str
    scores: tuple[str, ...] = field(default=("psnr",))


FULL = "full"
ACTING_DISTANCE = 5e-6
"""Weight of the sum in L_dist at which its gradient is 0.3 to 0.8 of the picture's, where it acts
(``loss_gradients``): the printed weight, 0.005, is a thousand times as much, and as a mean it is below 0.001."""
FULL_METHODS: Mapping[str, StreamConfig] = {
    "rig": PRESETS["rig"],
    "paper-n3dv": PRESETS["paper-n3dv"],
    "paper-n3dv, l_v as six scales": replace(
        PAPER, online=replace(PAPER.online, dynamic=PAPER.online.dynamic.union(["base_scales"]))
    ),
}
"""The methods that studies edit: what the row ``full`` may be."""
COSTS = ("bytes_with_header", "decode_and_render_fps")
"""The last columns of every table: the paper's starred storage, and its rendering speed."""

TABLES: Mapping[str, AblationTable] = {
    table.key: table
    for table in (
        AblationTable(
            key="structured",
            title="What of the anchors is trained online",
            scene="sear steak, N3DV",
            rows={
                "without-scaling-factor": {"psnr": 33.53},
                "without-covariance-mlp": {"psnr": 33.68},
                "with-opacity-mlp": {"psnr": 33.78},
                "with-color-mlp": {"psnr": 33.41},
                FULL: {"psnr": 33.81},
            },
            claim="l_v and F_Sigma must be trained; training F_alpha or F_c as well makes it worse",
            scores=("psnr", "online_bytes", "e_warp", "t_lpips", "temporal_flip", "flicker", *COSTS),
        ),
        AblationTable(
            key="free",
            title="Free 3DGs: generation and pruning",
            scene="flame steak, N3DV",
            rows={
                "without-free": {"psnr": 33.26, "free_bytes": 0.0, "t_lpips": 1.55e-2, "e_warp": 4.89e-3},
                "uniform-spawn": {"psnr": 33.48, "free_bytes": 2.28e6, "t_lpips": 1.52e-2, "e_warp": 4.85e-3},
                "random-spawn": {},
                "harmonic-color": {},
                "without-quantity-control": {
                    "psnr": 33.93,
                    "free_bytes": 2.87e6,
                    "t_lpips": 1.45e-2,
                    "e_warp": 4.70e-3,
                },
                FULL: {"psnr": 33.98, "free_bytes": 1.40e6, "t_lpips": 1.42e-2, "e_warp": 4.41e-3},
            },
            claim="free 3DGs where the gradient is large are worth it; pruning halves them at no loss",
            scores=("psnr", "online_free_bytes", "e_warp", "t_lpips", "temporal_flip", "flicker", *COSTS),
        ),
        AblationTable(
            key="patching",
            title="Global patching against generation for each frame",
            scene="coffee martini, N3DV",
            rows={
                "without-free": {"psnr": 27.60, "free_bytes": 0.0, "t_lpips": 1.46e-2, "e_warp": 73.1e-3},
                "independent-1": {"psnr": 27.74, "free_bytes": 0.01e6, "t_lpips": 1.44e-2, "e_warp": 68.0e-3},
                "independent-2": {"psnr": 27.67, "free_bytes": 0.29e6, "t_lpips": 1.44e-2, "e_warp": 67.6e-3},
                "independent-3": {"psnr": 27.70, "free_bytes": 0.41e6, "t_lpips": 1.43e-2, "e_warp": 67.1e-3},
                FULL: {"psnr": 27.83, "free_bytes": 0.38e6, "t_lpips": 1.39e-2, "e_warp": 65.9e-3},
            },
            claim="free 3DGs that are inherited beat those generated anew for each frame, whatever the threshold",
            scores=("psnr", "online_free_bytes", "e_warp", "t_lpips", "temporal_flip", "flicker", *COSTS),
        ),
        AblationTable(
            key="distance",
            title="Distance regularisation at frame 0",
            scene="coffee martini, N3DV (pictures only)",
            rows={"without-distance": {}, "acting-distance": {}, "printed-distance": {}, FULL: {}},
            claim="without L_dist noise appears in later frames",
            scores=("psnr", "e_warp", "t_lpips", "temporal_flip", "flicker", *COSTS),
        ),
    )
}


def variants(full: StreamConfig) -> dict[str, Variant]:
    """Every variant of the paper's tables, and ``held``, which shows frame 0 for ever: what not updating costs."""
    rows = [Variant(FULL, "full method", full)]

    def online(key: str, title: str, config: OnlineConfig, *changes: str) -> None:
        rows.append(
            Variant(key, title, replace(full, online=config), frozenset(f"online.{change}" for change in changes))
        )

    def dynamic(key: str, title: str, fields: frozenset[FieldName]) -> None:
        online(key, title, replace(full.online, dynamic=fields), "dynamic")

    def patching(key: str, title: str, config: PatchingConfig, *changes: str) -> None:
        paths = [f"patching.{change}" for change in changes]
        online(key, title, replace(full.online, patching=config), *paths)

    base, patch = full.online.dynamic, full.online.patching
    # Where l_v is read as all six scales of Scaffold-GS, both go.
    dynamic("without-scaling-factor", "w/o scaling factor", base.difference(["offset_scales", "base_scales"]))
    dynamic("without-covariance-mlp", "w/o covariance MLP", base.difference(["covariance_mlp"]))
    dynamic("with-opacity-mlp", "w opacity MLP", base.union(["opacity_mlp"]))
    dynamic("with-color-mlp", "w colour MLP", base.union(["color_mlp"]))
    patching("without-free", "w/o free 3DGs", replace(patch, spawn="off"), "spawn")
    patching("uniform-spawn", "random generation", replace(patch, spawn="uniform"), "spawn")
    patching("random-spawn", "random parents", replace(patch, spawn="random"), "spawn")
    rates = replace(full.online.rates, free_color="sh")
    harmonic = replace(full.online, rates=rates)
    online("harmonic-color", "colour as a spherical harmonic", harmonic, "rates.free_color")
    patching("without-quantity-control", "w/o quantity control", replace(patch, prune_opacity=None), "prune_opacity")
    alone = replace(patch, lifetime="frame")
    patching("independent-1", "I1: independent, tau 0.001", alone, "lifetime")
    for key, threshold in (("independent-2", 1.5e-4), ("independent-3", 1e-4)):
        title = f"I{key[-1]}: independent, tau {threshold:g}"
        patching(key, title, replace(alone, grad_threshold=threshold), "lifetime", "grad_threshold")

    def distance(key: str, title: str, **changes: Any) -> None:
        losses = replace(full.initial.losses, **changes)
        config = replace(full, initial=replace(full.initial, losses=losses))
        rows.append(Variant(key, title, config, frozenset(f"initial.losses.{change}" for change in changes)))

    distance("without-distance", "w/o distance regularisation", offset_distance=0.0)
    title = "a thousandth of the printed sum"
    distance("acting-distance", title, offset_distance=ACTING_DISTANCE, offset_distance_reduction="sum")
    distance("printed-distance", "the printed sum", offset_distance_reduction="sum")
    dark = replace(full.online.exposure, enabled=False)
    still = replace(full.online, iterations=0, dynamic=frozenset(), patching=replace(patch, spawn="off"), exposure=dark)
    online("held", "frame 0 held", still, "iterations", "dynamic", "patching.spawn")
    return {variant.key: variant for variant in rows}
