# SPDX-License-Identifier: Apache-2.0
"""Results as tables of text, for a terminal and for documents."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from structgstream_studies.experiments.results import Result
from structgstream_studies.experiments.summary import Spread, Summary, summaries, verdict
from structgstream_studies.experiments.variants import FULL, AblationTable


@dataclass(frozen=True)
class Score:
    """Format of a score.

    Args:
        title: head of its column, with its unit.
        digits: number of decimals.
        factor: conversion to the unit.
        better: 1 if more is better, -1 if less is, 0 if neither is claimed.
    """

    title: str
    digits: int
    factor: float = 1.0
    better: int = 1


SCORES: Mapping[str, Score] = {
    "psnr": Score("PSNR, dB", 2),
    "psnr_camera_color": Score("colour held, dB", 2),
    "psnr_first": Score("frame 0, dB", 2),
    "ssim": Score("SSIM", 4),
    "ms_ssim": Score("MS-SSIM", 4),
    "flip": Score("FLIP", 4, better=-1),
    "lpips_alex": Score("LPIPS", 4, better=-1),
    "psnr_affine": Score("affine, dB", 2),
    "psnr_changed": Score("changed, dB", 2),
    "psnr_still": Score("still, dB", 2),
    "drift_db_per_frame": Score("drift, dB a frame", 3),
    "drop_from_first_db": Score("drop, dB", 2, better=-1),
    "online_free_bytes": Score("free 3DGs, MB a frame", 2, 1e-6, -1),
    "online_bytes": Score("MB a frame", 2, 1e-6, -1),
    "online_kilobytes": Score("KB a frame", 1, 1e-3, -1),
    "bytes_with_header": Score("with the header, MB a frame", 2, 1e-6, -1),
    "kilobytes_with_header": Score("with the header, KB a frame", 1, 1e-3, -1),
    "e_warp": Score("E_warp, 1e-3", 3, 1e3, -1),
    "t_lpips": Score("T-LPIPS, 1e-2", 3, 1e2, -1),
    "temporal_flip": Score("temporal FLIP, 1e-3", 2, 1e3, -1),
    "flicker": Score("flicker, 1/255", 3, 1.0, -1),
    "online_cpu_seconds": Score("core-s a frame", 1, better=-1),
    "first_cpu_seconds": Score("frame 0, core-s", 0, better=-1),
    "decode_and_render_fps": Score("pictures a second", 1),
}
TEMPORAL = frozenset({"drift_db_per_frame", "e_warp", "t_lpips", "temporal_flip", "flicker"})
"""Scores of consecutive frames; invalid if only every tenth frame is evaluated."""
PAPER_SCORES: Mapping[str, str] = {"online_free_bytes": "free_bytes"}
"""Where the paper's figure has another key than ours."""


@dataclass(frozen=True)
class Sheet:
    """A table of text: the first column names the rows."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


def ablation_sheet(table: AblationTable, results: Iterable[Result], *, titles: Mapping[str, str]) -> Sheet:
    """One of the paper's tables: ours, the difference to the full method, the paper's figures, and what follows.

    The verdict is on PSNR (``summary.verdict``); variants without a result have dashes, and no row if the paper has no
    figure of them either.
    """
    found = summaries(results)
    full = found.get(FULL)
    extra = [name for name in table.scores if name != "psnr"]
    held = "psnr_camera_color"
    columns = ["variant", "PSNR, dB", SCORES[held].title, "to full, dB", "paper, dB", "paper to full, dB"]
    columns.append("the paper's order")
    for name in extra:
        columns.append(SCORES[name].title)
        if _paper_has(table, name):
            columns.append(f"paper: {SCORES[name].title}")
    rows = []
    for key, paper in table.rows.items():
        if key not in found and not paper:
            continue
        row = [titles[key], *(_cell(found.get(key), name) for name in ("psnr", held))]
        row.append(_difference(found.get(key), full, key))
        theirs = paper.get("psnr")
        theirs_full = table.rows[FULL].get("psnr")
        row.append("-" if theirs is None else f"{theirs:.2f}")
        gap = None if theirs is None or theirs_full is None or key == FULL else theirs - theirs_full
        row.append("-" if gap is None else f"{gap:+.2f}")
        row.append(_verdict(found.get(key), full, gap, key))
        for name in extra:
            row.append(_cell(found.get(key), name))
            if _paper_has(table, name):
                row.append(_paper(paper, name))
        rows.append(row)
    return _without_empty_columns(Sheet(table.title, columns, rows))


def comparison_sheet(results: Iterable[Result], *, titles: Mapping[str, str], scores: Sequence[str]) -> Sheet:
    """Methods side by side: mean over seeds and spread of each score that at least one of them has.

    Methods that were run on some frames only have no temporal scores.
    """
    found = summaries(results)
    shown = [name for name in scores if any(summary.score(name) is not None for summary in found.values())]
    keys = [key for key in titles if key in found]
    rows = []
    for key in keys:
        subsampled = any(result.identity["capture"]["every"] > 1 for result in found[key].results.values())
        cells = ["-" if subsampled and name in TEMPORAL else _cell(found[key], name) for name in shown]
        rows.append([titles[key], str(len(found[key].results)), *cells])
    return Sheet("Methods", ["method", "seeds", *(SCORES[name].title for name in shown)], rows)


def markdown(sheet: Sheet) -> str:
    """The sheet as a table in Markdown, without its title."""
    lines = [_line(sheet.columns), _line(["---"] + ["---:"] * (len(sheet.columns) - 1))]
    return "\n".join([*lines, *(_line(row) for row in sheet.rows)]) + "\n"


def _without_empty_columns(sheet: Sheet) -> Sheet:
    kept = [i for i in range(len(sheet.columns)) if i == 0 or any(row[i] != "-" for row in sheet.rows)]
    return Sheet(sheet.title, [sheet.columns[i] for i in kept], [[row[i] for i in kept] for row in sheet.rows])


def _line(cells: Iterable[str]) -> str:
    # A bar inside a cell would begin another one.
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def format_score(value: Spread | None, name: str, *, signed: bool = False) -> str:
    """A score as text: mean, and the deviation over seeds where there are several."""
    if value is None:
        return "-"
    score = SCORES[name]
    sign = "+" if signed else ""
    text = f"{value.mean * score.factor:{sign}.{score.digits}f}"
    return f"{text} ± {value.deviation * score.factor:.{score.digits}f}" if value.count > 1 else text


def _cell(summary: Summary | None, name: str) -> str:
    return "-" if summary is None else format_score(summary.score(name), name)


def _difference(summary: Summary | None, full: Summary | None, key: str) -> str:
    if summary is None or full is None or key == FULL:
        return "-"
    return format_score(summary.difference(full, "psnr"), "psnr", signed=True)


def _verdict(summary: Summary | None, full: Summary | None, gap: float | None, key: str) -> str:
    if key == FULL or summary is None or full is None:
        return "-"
    return verdict(summary, full, "psnr", expected_sign=-1.0 if gap is None else gap)


def _paper_has(table: AblationTable, name: str) -> bool:
    return any(PAPER_SCORES.get(name, name) in row for row in table.rows.values())


def _paper(paper: Mapping[str, float], name: str) -> str:
    value = paper.get(PAPER_SCORES.get(name, name))
    score = SCORES[name]
    return "-" if value is None else f"{value * score.factor:.{score.digits}f}"
