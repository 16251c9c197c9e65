# SPDX-License-Identifier: Apache-2.0
"""What each part against motion is worth: all of them, none, each left out, and each without the others' help."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from structgstream.errors import ConfigError
from structgstream.session.presets import StreamConfig
from structgstream.training.online.config import OnlineConfig
from structgstream_studies.experiments.effects import WHOLE, require_compact
from structgstream_studies.experiments.variants import Variant

PARTS_TABLE = "parts"
NONE = f"{WHOLE}-without-parts"
"""Key of the row without any of the parts of later frames."""
DENOISING, FREE_SPACE = "denoising.frames", "initial.floaters.enabled"
"""Switches of the parts of frame 0, which are only left out: whatever follows needs some frame 0."""


@dataclass(frozen=True)
class Part:
    """A part of later frames.

    Args:
        title: its name in tables.
        field: the switch of :class:`~structgstream.training.online.config.OnlineConfig` that it has.
        without: the configuration with the switch off.
    """

    title: str
    field: str
    without: Callable[[OnlineConfig], OnlineConfig]


PARTS: Mapping[str, Part] = {
    "start": Part(
        "motion start", "scene_flow.enabled", lambda c: replace(c, scene_flow=replace(c.scene_flow, enabled=False))
    ),
    "births": Part(
        "births from geometry", "spawn.enabled", lambda c: replace(c, spawn=replace(c.spawn, enabled=False))
    ),
    "residuals": Part(
        "gate that sees residuals",
        "motion.residual_threshold",
        lambda c: replace(c, motion=replace(c.motion, residual_threshold=0.0)),
    ),
    "carrying": Part(
        "hidden anchors carried along",
        "motion.occluded_share",
        lambda c: replace(c, motion=replace(c.motion, occluded_share=0.0)),
    ),
    "coherence": Part(
        "price of incoherent motion",
        "smoothness.weight",
        lambda c: replace(c, smoothness=replace(c.smoothness, weight=0.0)),
    ),
    "prior": Part("motion prior", "motion_prior", lambda c: replace(c, motion_prior=0.0)),
}


def parts(full: StreamConfig) -> dict[str, Variant]:
    """The rows of the table, by key.

    Args:
        full: the compact stream with every part.

    Raises:
        ConfigError: ``full`` is no compact stream, or a part is off in it.
    """
    require_compact(full)
    rows = [
        Variant(WHOLE, "everything", full),
        _without(full, NONE, f"none of the {len(PARTS)} parts below", PARTS),
    ]
    for name, part in PARTS.items():
        others = {key: other for key, other in PARTS.items() if key != name}
        rows.append(_without(full, f"{WHOLE}-less-{name}", f"without {part.title}", {name: part}))
        rows.append(_without(full, f"{WHOLE}-only-{name}", f"{part.title} alone", others))
    noisy = replace(full, denoising=replace(full.denoising, frames=1))
    rows.append(Variant(f"{WHOLE}-less-denoising", "frame 0 of one picture a camera", noisy, frozenset([DENOISING])))
    floating = replace(full.initial, floaters=replace(full.initial.floaters, enabled=False))
    hazy = replace(full, initial=floating)
    rows.append(Variant(f"{WHOLE}-less-free-space", "anchors in free space are kept", hazy, frozenset([FREE_SPACE])))
    for row in rows:
        if len(row.changes) == 1 and row.config == full:
            raise ConfigError(
                f"The table {PARTS_TABLE} leaves out {min(row.changes)}, which is off already; take a configuration in "
                "which it is on."
            )
    return {row.key: row for row in rows}


def _without(full: StreamConfig, key: str, title: str, left_out: Mapping[str, Part]) -> Variant:
    online = full.online
    for part in left_out.values():
        online = part.without(online)
    changes = frozenset(f"online.{part.field}" for part in left_out.values())
    return Variant(key, title, replace(full, online=online), changes)
