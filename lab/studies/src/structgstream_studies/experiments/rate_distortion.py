# SPDX-License-Identifier: Apache-2.0
"""Rate-distortion: the compact stream at several qualities as a curve, compared with other methods.

Rates are bytes of packets after the first, including framing and key packets. Curves are compared over the seeds that
all their points have, and with a method over those of them that it has too, because seeds differ more than methods
(``summary.py``, Note [Paired differences]).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from structgstream.errors import ConfigError
from structgstream.session.presets import StreamConfig
from structgstream_studies.experiments.bd_rate import bd_psnr, bd_rate, psnr_at, rate_at
from structgstream_studies.experiments.effects import WHOLE, require_compact
from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.sheets import SCORES, Sheet, format_score
from structgstream_studies.experiments.summary import Spread, Summary, summaries
from structgstream_studies.experiments.variants import FULL, Variant

RATES_TABLE = "rates"
QUALITIES = (-2, -1, 0, 1, 2)
OTHERS: Mapping[str, str] = {FULL: "paper mode", "3dgstream": "3DGStream's method"}
"""Methods with a single point that the curve is compared with, if a study has them."""
JUDGED: Mapping[str, str] = {"psnr": "PSNR", "psnr_changed": "PSNR of changed pixels"}
"""Scores for which rates are compared."""

Point = tuple[float, float]
"""Kilobytes a frame, and decibels."""


def qualities(full: StreamConfig) -> dict[str, Variant]:
    """The points of the curve by key, coarsest first; the point of ``full`` has the key that it has in other tables.

    Raises:
        ConfigError: ``full`` is no compact stream.
    """
    require_compact(full)
    rows = {}
    for quality in QUALITIES:
        rounding = replace(full.online.rounding, quality=full.online.rounding.quality + quality)
        config = replace(full, online=replace(full.online, rounding=rounding))
        changes = frozenset({"online.rounding.quality"} if quality else ())
        rows[quality_key(quality)] = Variant(quality_key(quality), quality_title(quality), config, changes)
    return rows


def quality_key(quality: int) -> str:
    """Key of a point of the curve."""
    return f"quality-{'m' if quality < 0 else 'p'}{abs(quality)}" if quality else WHOLE


def quality_title(quality: int) -> str:
    """Name of a point of the curve in tables."""
    return f"compact, quality {quality:+d}" if quality else "compact, quality 0"


def curve_titles() -> dict[str, str]:
    """The points of the curve and the methods beside it, with their names in tables."""
    return {quality_key(quality): quality_title(quality) for quality in QUALITIES} | dict(OTHERS)


def rates_sheet(results: Iterable[Result]) -> Sheet:
    """A row for each point of the curve, with dashes for missing results, and for each other method."""
    shown = [result for result in results if result.key in curve_titles()]
    found = summaries(shown)
    fps = next((float(result.identity["capture"]["fps"]) for result in shown), 0.0)
    scores = ("psnr", "psnr_camera_color", "psnr_changed")
    after = (("bytes_with_header", "kilobytes_with_header"), ("flicker", "flicker"))
    after += (("decode_and_render_fps", "decode_and_render_fps"),)
    heads = ["seeds", *(SCORES[name].title for name in scores), SCORES["online_kilobytes"].title, "Mbit/s"]
    heads += [SCORES[name].title for _, name in after]
    rows = []
    for key, title in curve_titles().items():
        summary = found.get(key)
        if summary is None:
            if key not in OTHERS:
                rows.append([title, *["-"] * len(heads)])
            continue
        cost = summary.score("online_bytes")
        cells = [format_score(summary.score(name), name) for name in scores]
        cells += [format_score(cost, "online_kilobytes"), _megabits(cost, fps)]
        cells += [format_score(summary.score(score), name) for score, name in after]
        rows.append([title, str(len(summary.results)), *cells])
    return Sheet("Rates", ["stream", *heads], rows)


def _megabits(cost: Spread | None, fps: float) -> str:
    return "-" if cost is None else f"{cost.mean * 8e-6 * fps:.2f}"


def versus_sheet(results: Iterable[Result]) -> tuple[Sheet, list[str]]:
    """The curve against each method of one point, by each judged score, and a sentence for each dash."""
    found = summaries(results)
    columns = [
        "against", "seeds", "its KB a frame", "its quality, dB", "curve at its quality, KB a frame", "to its, %",
        "curve at its rate, dB", "to its, dB",
    ]  # fmt: skip
    rows: list[list[str]] = []
    remarks: list[str] = []
    for key, method in OTHERS.items():
        for score, title in JUDGED.items():
            name = f"{method}, {title}"
            row, said = _versus(found, key, score)
            if row:
                rows.append([name, *row])
                remarks += [f"{name}: {remark}" for remark in said]
    return Sheet("The curve against other methods", columns, rows), remarks


def _versus(found: Mapping[str, Summary], key: str, score: str) -> tuple[list[str], list[str]]:
    """Cells of a method, none without a result, and the reasons of dashes."""
    seeds = common_seeds(found) & (found[key].results.keys() if key in found else set())
    its = _point(found[key], score, seeds) if seeds else None
    if its is None:
        return [], []
    rate, quality = its
    head = [str(len(seeds)), f"{rate:.1f}", f"{quality:.2f}"]
    curve, remarks = curve_of(found, score, seeds)
    if len(curve) < 2:
        return [*head, *["-"] * 4], [*remarks, f"The curve has {len(curve)} points, two are needed."]
    same_quality, same_rate = rate_at(curve, quality), psnr_at(curve, rate)
    (least, lowest), (most, highest) = curve[0], curve[-1]
    if same_quality is None:
        end = f"begins at {lowest:.2f} dB" if quality < lowest else f"ends at {highest:.2f} dB"
        remarks.append(f"Its {quality:.2f} dB are not on the curve, which {end}.")
    if same_rate is None:
        end = f"begins at {least:.1f} KB" if rate < least else f"ends at {most:.1f} KB"
        remarks.append(f"Its {rate:.1f} KB a frame are not on the curve, which {end}.")
    cells = ["-", "-"] if same_quality is None else [f"{same_quality:.1f}", f"{100 * (same_quality / rate - 1):+.1f}"]
    cells += ["-", "-"] if same_rate is None else [f"{same_rate:.2f}", f"{same_rate - quality:+.2f}"]
    return [*head, *cells], remarks


def bd_sheet(ours: Iterable[Result], theirs: Iterable[Result]) -> tuple[Sheet, list[str]]:
    """Bjontegaard's differences of the curve of one study to that of another, over the seeds that both have."""
    one, other = summaries(ours), summaries(theirs)
    seeds = common_seeds(one) & common_seeds(other)
    rows: list[list[str]] = []
    remarks: list[str] = []
    for score, title in JUDGED.items():
        curves = [curve_of(found, score, seeds) for found in (one, other)]
        remarks += [f"{title}: {remark}" for _, said in curves for remark in said]
        (first, _), (second, _) = curves
        try:
            row = [f"{bd_rate(first, second):+.1f}", f"{bd_psnr(first, second):+.2f}"]
        except ConfigError as error:
            row = ["-", "-"]
            remarks.append(f"{title}: {error}")
        rows.append([title, str(len(seeds)), *row])
    return Sheet("One curve against another", ["by", "seeds", "BD-rate, %", "BD-PSNR, dB"], rows), remarks


def common_seeds(found: Mapping[str, Summary]) -> set[int]:
    """Seeds that all points of the curve have."""
    seeds = [set(found[key].results) for key in map(quality_key, QUALITIES) if key in found]
    return set.intersection(*seeds) if seeds else set()


def curve_of(found: Mapping[str, Summary], score: str, seeds: set[int]) -> tuple[list[Point], list[str]]:
    """The curve by increasing rate and quality, and a sentence for each dominated point."""
    points: list[tuple[Point, str]] = []
    for quality in QUALITIES:
        key = quality_key(quality)
        point = _point(found[key], score, seeds) if key in found and seeds else None
        if point is not None:
            points.append((point, quality_title(quality)))
    kept: list[Point] = []
    remarks = []
    for (rate, decibels), name in sorted(points, key=lambda entry: (entry[0][0], -entry[0][1])):
        if kept and decibels <= kept[-1][1]:
            remarks.append(f"Left out: {name}, which is no better than a point of the curve with fewer bytes.")
        else:
            kept.append((rate, decibels))
    return kept, remarks


def _point(summary: Summary, score: str, seeds: Iterable[int]) -> Point | None:
    """Means over ``seeds``."""
    part = Summary(summary.key, {seed: summary.results[seed] for seed in seeds})
    cost, quality = part.score("online_bytes"), part.score(score)
    return None if cost is None or quality is None or cost.mean <= 0 else (cost.mean * 1e-3, quality.mean)


def bullet_list(remarks: Sequence[str]) -> str:
    """Sentences as a list in Markdown; nothing for none."""
    return "".join(["\n", *(f"- {remark}\n" for remark in remarks)]) if remarks else ""
