# SPDX-License-Identifier: Apache-2.0
"""Alternative readings of what the paper leaves open, as values that can be run and scored.

Readings are chosen by a camera that is held out for this purpose only, so that reported results are not biased by the
choice.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from structgstream.session.presets import StreamConfig
from structgstream.training.frame0.fit import InitialConfig
from structgstream.training.losses import LossWeights
from structgstream.training.online.config import OnlineConfig
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import SCORES, Sheet, format_score
from structgstream_studies.experiments.summary import summaries

BASE = "reading-default"


@dataclass(frozen=True)
class Reading:
    """One reading of a point that the paper leaves open.

    Args:
        question: the open point.
        answer: this reading.
        edit: from the default configuration to this one.
    """

    question: str
    answer: str
    edit: Callable[[StreamConfig], StreamConfig]


def _initial(edit: Callable[[InitialConfig], InitialConfig]) -> Callable[[StreamConfig], StreamConfig]:
    return lambda config: replace(config, initial=edit(config.initial))


def _online(edit: Callable[[OnlineConfig], OnlineConfig]) -> Callable[[StreamConfig], StreamConfig]:
    return lambda config: replace(config, online=edit(config.online))


def _losses(
    edit: Callable[[LossWeights], LossWeights], *, everywhere: bool = True
) -> Callable[[StreamConfig], StreamConfig]:
    def edited(config: StreamConfig) -> StreamConfig:
        initial = replace(config.initial, losses=edit(config.initial.losses))
        online = replace(config.online, losses=edit(config.online.losses)) if everywhere else config.online
        return replace(config, initial=initial, online=online)

    return edited


READINGS: Mapping[str, Reading] = {
    BASE: Reading("-", "the defaults", lambda config: config),
    "reading-base-scales": Reading(
        "which of Scaffold-GS's six scales l_v is",
        "all six: the base scales move as well",
        _online(lambda online: replace(online, dynamic=online.dynamic.union(["base_scales"]))),
    ),
    "reading-no-distance": Reading(
        "whether the MLPs see the distance",
        "no, as Scaffold-GS's code",
        _initial(lambda initial: replace(initial, distance_input=False)),
    ),
    "reading-volume-sum": Reading(
        "L_vol a sum or a mean", "sum, as printed", _losses(lambda losses: replace(losses, volume_reduction="sum"))
    ),
    "reading-l1": Reading(
        "the weight of L1", "0.8, as Scaffold-GS's code", _losses(lambda losses: replace(losses, l1=0.8))
    ),
    "reading-distance-sum": Reading(
        "L_dist a sum or a mean",
        "sum, as printed",
        _losses(lambda losses: replace(losses, offset_distance_reduction="sum"), everywhere=False),
    ),
    "reading-window": Reading(
        "which iterations feed the view-space gradient",
        "the last 20 before patching, as 3DGStream's code",
        _online(lambda online: replace(online, patching=replace(online.patching, collect_from=30))),
    ),
}


def readings_sheet(results: Iterable[Result]) -> Sheet:
    """Every reading beside the default: mean over seeds, and the difference seed by seed."""
    found = summaries(result for result in results if result.key in READINGS)
    base = found.get(BASE)
    scores = ("psnr_first", "psnr", "psnr_camera_color", "psnr_changed")
    rows = []
    for key, reading in READINGS.items():
        if key not in found:
            continue
        summary = found[key]
        cells = [format_score(summary.score(name), name) for name in scores]
        difference = None if base is None or key == BASE else summary.difference(base, "psnr")
        rows.append([reading.question, reading.answer, *cells, format_score(difference, "psnr", signed=True)])
    heads = [SCORES[name].title for name in scores]
    return Sheet("Readings", ["question", "reading", *heads, "to the default, dB"], rows)
