# SPDX-License-Identifier: Apache-2.0
"""The HTML page of a report's folder: worst frames first, then plots over time and the contact sheet."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from structgstream.atomic_files import atomic_write
from structgstream.evaluation.pictures import write_png
from structgstream.evaluation.worst import Crop

PAGE, FOLDER = "index.html", "worst"
HEADINGS = {"changed": "Worst on changed pixels", "ghosts": "Most ghosts"}
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; }
h1 { font-size: 1.3rem; } h2 { font-size: 1.1rem; margin: 2rem 0 .5rem; } figcaption { color: #555; }
figure { margin: 0 0 1.2rem; overflow-x: auto; } figure img { image-rendering: pixelated; }
img.wide { max-width: 100%; }
"""


def write_worst(folder: Path, crops: Sequence[Crop]) -> list[str]:
    """Writes each crop at full size as a PNG file below ``folder``; returns their names relative to it.

    Raises:
        StorageError: a file cannot be written.
    """
    names = []
    for crop in crops:
        safe = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in crop.camera)
        names.append(f"{FOLDER}/{crop.reason}-{crop.frame:06d}-{safe}.png")
        write_png(folder / names[-1], crop.picture)
    return names


def write_page(folder: Path, crops: Sequence[Crop], *, title: str, pictures: Sequence[str]) -> None:
    """Writes ``index.html`` and the crops into the folder of a report.

    Args:
        folder: folder of the report.
        crops: the worst windows.
        title: heading.
        pictures: file names of further pictures in the folder.

    Raises:
        StorageError: a file cannot be written.
    """
    names = write_worst(folder, crops)
    parts = [
        f"<!doctype html>\n<html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        f"<meta name=viewport content='width=device-width'><style>{STYLE}</style><h1>{escape(title)}</h1>",
    ]
    for reason, heading in HEADINGS.items():
        figures = [_figure(name, crop) for name, crop in zip(names, crops, strict=True) if crop.reason == reason]
        if figures:
            parts += [f"<h2>{heading}</h2><p>Truth, rendering, difference times four.</p>", *figures]
    parts += [f"<p><img class=wide src='{quote(name)}' alt='{escape(name)}'>" for name in pictures]
    parts.append("<p>Every number: <a href='report.json'>report.json</a></html>\n")
    atomic_write(folder / PAGE, "\n".join(parts).encode(), called="The page", new_folder=True, sync=False)


def _figure(name: str, crop: Crop) -> str:
    window, height = crop.window, crop.picture.shape[0]
    where = f"{window.width}x{window.height} pixels at ({window.x}, {window.y})"
    caption = f"Frame {crop.frame}, camera {crop.camera}: {_caption(crop)}; {where}"
    shown = height * (2 if height < 200 else 1)
    image = f"<img src='{quote(name)}' height={shown} alt='{escape(caption)}'>"
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _caption(crop: Crop) -> str:
    if crop.reason == "changed":
        return f"{crop.scores['psnr_changed']:.2f} dB on changed pixels"
    return (
        f"{crop.scores['ghost_share']:.1%} of the disoccluded pixels, which are "
        f"{crop.scores['disoccluded_share']:.1%} of the picture"
    )
