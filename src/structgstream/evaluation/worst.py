# SPDX-License-Identifier: Apache-2.0
"""The worst frames of a stream, the worst window of each, and the page that shows them.

A frame is bad by its PSNR on changed pixels, or by its ghosts (``ghosts.py``). A mean over a picture or a stream hides
both, because moving content is a small part of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_write
from structgstream.evaluation.metrics import Picture, changed_pixels, squared_errors
from structgstream.evaluation.pictures import side_by_side, write_png
from structgstream.evaluation.report import FrameScores, Scores

if TYPE_CHECKING:
    from structgstream.evaluation.evaluate import Compared

Reason = Literal["changed", "ghosts"]
REASONS: tuple[Reason, ...] = ("changed", "ghosts")
MOST = 3
MIN_SHARE = 0.001
"""Smallest share of changed pixels over which a PSNR is meaningful."""
WINDOW_SHARE = 0.25
"""Side of a window, as a share of the picture's longer side."""


def badness(scores: Scores, reason: Reason) -> float | None:
    """Measure of a picture's error, larger is worse; None if it is not bad for this reason."""
    if reason == "changed":
        enough = scores.changed_share >= MIN_SHARE
        return -scores.psnr_changed if enough and scores.psnr_changed is not None else None
    return (scores.ghost_share or 0.0) * (scores.disoccluded_share or 0.0) or None


def worst_facts(frames: Sequence[FrameScores]) -> dict[str, dict[str, Any] | None]:
    """The worst picture by reason: ``frame``, ``camera``, and ``psnr_changed`` or ``ghost_share`` and
    ``disoccluded_share``; None if no picture is bad."""
    found: dict[str, dict[str, Any] | None] = {}
    for reason in REASONS:
        rows = [
            (bad, frame.index, name, scores)
            for frame in frames
            for name, scores in frame.cameras.items()
            if (bad := badness(scores, reason)) is not None
        ]
        worst = max(rows, key=lambda row: row[0], default=None)
        found[reason] = None if worst is None else {"frame": worst[1], "camera": worst[2], **shown(worst[3], reason)}
    return found


def shown(scores: Scores, reason: Reason) -> dict[str, float | None]:
    """The scores by which a picture is chosen."""
    if reason == "changed":
        return {"psnr_changed": scores.psnr_changed}
    return {"ghost_share": scores.ghost_share, "disoccluded_share": scores.disoccluded_share}


@dataclass(frozen=True)
class Crop:
    """A bad window of a bad frame: truth, rendering and their difference times four, side by side."""

    reason: Reason
    frame: int
    camera: str
    caption: str
    picture: Picture


@dataclass
class WorstPictures:
    """Collects the worst pictures of an evaluation: at most one per frame and three per reason."""

    _worst: dict[Reason, dict[int, tuple[float, "Compared"]]] = field(default_factory=dict, init=False)

    def see(self, index: int, compared: "Compared") -> None:
        """Stores the picture if it is among the worst so far."""
        for reason in REASONS:
            bad, worst = badness(compared.scores, reason), self._worst.setdefault(reason, {})
            if bad is None or (index in worst and worst[index][0] >= bad):
                continue
            worst[index] = bad, compared
            if len(worst) > MOST:
                del worst[min(worst, key=lambda frame: worst[frame][0])]

    def crops(self) -> list[Crop]:
        """The worst window of each, the worst picture of each reason first."""
        found = []
        for reason in REASONS:
            worst = sorted(self._worst.get(reason, {}).items(), key=lambda item: -item[1][0])
            found += [_crop(reason, index, compared) for index, (_, compared) in worst]
        return found


def _crop(reason: Reason, index: int, compared: "Compared") -> Crop:
    rows, columns = worst_window(_error_map(reason, compared))
    scores = compared.scores
    if reason == "changed":
        why = f"{scores.psnr_changed:.2f} dB on changed pixels"
    else:
        why = (
            f"{scores.ghost_share:.1%} of the disoccluded pixels, which are {scores.disoccluded_share:.1%} of the "
            "picture"
        )
    size = f"{columns.stop - columns.start}x{rows.stop - rows.start}"
    caption = f"Frame {index}, camera {compared.camera}: {why}; {size} pixels at ({columns.start}, {rows.start})"
    picture = side_by_side(compared.truth[rows, columns], compared.picture[rows, columns])
    return Crop(reason, index, compared.camera, caption, picture)


def _error_map(reason: Reason, compared: "Compared") -> NDArray[np.int64]:
    """Squared errors ``[H, W]`` of the pixels that a picture was chosen by."""
    errors = squared_errors(compared.picture, compared.truth).astype(np.int64)
    if reason == "changed":
        return errors * changed_pixels(compared.truth, compared.first, compared.counting)
    assert compared.ghosts is not None
    factor, (height, width) = compared.ghosts.factor, errors.shape
    ghosts = compared.ghosts.ghosts.repeat(factor, 0).repeat(factor, 1)
    return errors * np.pad(ghosts, ((0, height - ghosts.shape[0]), (0, width - ghosts.shape[1])))


def worst_window(errors: NDArray[np.int64]) -> tuple[slice, slice]:
    """Rows and columns of the window with the largest sum of ``errors`` ``[H, W]``, the first of equal ones."""
    height, width = errors.shape
    side = max(1, round(WINDOW_SHARE * max(height, width)))
    high, wide = min(side, height), min(side, width)
    total = np.pad(errors.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    sums = total[high:, wide:] - total[:-high, wide:] - total[high:, :-wide] + total[:-high, :-wide]
    y, x = divmod(int(sums.argmax()), sums.shape[1])
    return slice(y, y + high), slice(x, x + wide)


PAGE, FOLDER = "index.html", "worst"
HEADINGS = {"changed": "Worst on changed pixels", "ghosts": "Most ghosts"}
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; }
h1 { font-size: 1.3rem; } h2 { font-size: 1.1rem; margin: 2rem 0 .5rem; } figcaption { color: #555; }
figure { margin: 0 0 1.2rem; overflow-x: auto; } figure img { image-rendering: pixelated; }
img.wide { max-width: 100%; }
"""


def write_page(folder: Path, crops: Sequence[Crop], *, title: str, pictures: Sequence[str]) -> None:
    """Writes ``index.html``, and each crop at full size as a PNG file, into the folder of a report. Raises StorageError
    if a file cannot be written."""
    parts = [
        f"<!doctype html>\n<html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        f"<meta name=viewport content='width=device-width'><style>{STYLE}</style><h1>{escape(title)}</h1>",
    ]
    for reason, heading in HEADINGS.items():
        figures = [_figure(folder, crop) for crop in crops if crop.reason == reason]
        if figures:
            parts += [f"<h2>{heading}</h2><p>Truth, rendering, difference times four.</p>", *figures]
    parts += [f"<p><img class=wide src='{quote(name)}' alt='{escape(name)}'>" for name in pictures]
    parts.append("<p>Every number: <a href='report.json'>report.json</a></html>\n")
    atomic_write(folder / PAGE, "\n".join(parts).encode(), called="The page", new_folder=True, sync=False)


def _figure(folder: Path, crop: Crop) -> str:
    """Writes the picture; returns its element of the page."""
    safe = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in crop.camera)
    name = f"{FOLDER}/{crop.reason}-{crop.frame:06d}-{safe}.png"
    write_png(folder / name, crop.picture)
    height, caption = crop.picture.shape[0], escape(crop.caption)
    image = f"<img src='{quote(name)}' height={height * (2 if height < 200 else 1)} alt='{caption}'>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
