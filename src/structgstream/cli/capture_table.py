# SPDX-License-Identifier: Apache-2.0
"""What was understood of a capture, as one screen: ``structgstream inspect FOLDER``. Nothing is trained."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from structgstream.cli.tables import compact_table, literal_cells, name_value_table

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource
    from structgstream.data.video_index import VideoTrack


def describe_capture(path: Path) -> dict[str, Any]:
    """The capture at ``path`` as plain values: ``layout``, ``fps``, ``frames``, ``held_out``, ``cameras``, ``remarks``.

    ``remarks`` are the warnings of its reader: what is left out, and why. A folder without calibration is described as
    the footage that ``prepare`` would read.

    Raises:
        CaptureError: it cannot be opened.
    """
    from structgstream.data.open import Uncalibrated, layout_of, open_capture
    from structgstream.preparation.footage import NoFootage

    with _warnings() as remarks:
        try:
            source = open_capture(path)
        except Uncalibrated as error:
            try:
                return _describe_footage(path, remarks)
            except NoFootage:
                raise error from None
        cameras = {name: _camera(source, name) for name in source.rig}
    return {
        "layout": layout_of(path),
        "fps": source.fps,
        "frames": len(source),
        "held_out": sorted(source.rig.held_out),
        "points": None if source.points is None else len(source.points),
        "cameras": cameras,
        "remarks": remarks,
    }


def _describe_footage(path: Path, remarks: list[str]) -> dict[str, Any]:
    from structgstream.preparation.footage import find_footage

    footage = find_footage(path)
    cameras: dict[str, Any] = {}
    for name in footage.cameras:
        stamps, track = footage.stamps(name), footage.tracks.get(name)
        colors, turned = ("-", "no") if track is None else (track.colors, _turned(track))
        cameras[name] = {
            "size": footage.size(name),
            "lens": "-",
            "frames": len(stamps),
            "colors": colors,
            "turned": turned,
        }
        cameras[name] |= {"first_seconds": float(stamps[0]), "last_seconds": float(stamps[-1])}
    remark = f"There is no calibration: structgstream prepare {path} -o CAPTURE makes a capture of these files."
    return {
        "layout": "videos or pictures without calibration",
        "fps": footage.fps,
        "frames": min(camera["frames"] for camera in cameras.values()),
        "held_out": [],
        "points": None,
        "cameras": cameras,
        "remarks": [*remarks, remark],
    }


def capture_tables(name: str, content: dict[str, Any]) -> tuple[Table, ...]:
    """The facts, a row per camera, and the remarks."""
    facts = name_value_table()
    facts.add_row(*literal_cells("capture", name))
    facts.add_row(*literal_cells("layout", content["layout"]))
    seconds = content["frames"] / content["fps"]
    facts.add_row("frames", f"{content['frames']} at {content['fps']:g} a second, {seconds:.2f} s")
    facts.add_row(*literal_cells("held out", ", ".join(content["held_out"]) or "none"))
    colors = {own["colors"] for own in content["cameras"].values()}
    if len(colors) == 1:
        facts.add_row(*literal_cells("colours", *colors))
    facts.add_row("points", "none" if content["points"] is None else f"{content['points']:,}")
    cameras = compact_table()
    cameras.title = "cameras"
    titles = ["camera", "size", "lens", "frames", "from s", "to s", "turned"]
    for title in titles + ["colours"] * (len(colors) > 1):
        cameras.add_column(title, justify="left" if title in ("camera", "lens", "colours") else "right")
    for camera, own in content["cameras"].items():
        times = ["-" if own[key] is None else f"{own[key]:.3f}" for key in ("first_seconds", "last_seconds")]
        size = "x".join(map(str, own["size"]))
        cells = (camera, size, own["lens"], str(own["frames"]), *times, own["turned"])
        cameras.add_row(*literal_cells(*cells, *([own["colors"]] if len(colors) > 1 else [])))
    remarks = name_value_table()
    for remark in content["remarks"]:
        remarks.add_row(*literal_cells("note", remark))
    return facts, cameras, remarks


def _camera(source: "FrameSource", name: str) -> dict[str, Any]:
    from structgstream.data.images import ImageSource
    from structgstream.data.undistortion import UndistortedSource
    from structgstream.data.video import VideoSource
    from structgstream.data.wrappers import SourceWrapper

    lens, stored = "pinhole", source
    while isinstance(stored, SourceWrapper):
        if isinstance(stored, UndistortedSource):
            lens = type(stored.filmed[name].lens).__name__
        stored = stored.source
    camera = stored.rig[name]
    found: dict[str, Any] = {"size": (camera.width, camera.height), "lens": lens, "frames": len(stored)}
    found |= {"first_seconds": None, "last_seconds": None, "colors": "-", "turned": "no"}
    if isinstance(stored, VideoSource):
        track, stamps = stored.tracks[name], [stamp for stamp in stored.stamps[name] if stamp is not None]
        times = [(stamp - track.origin) * track.tick_seconds for stamp in (stamps[0], stamps[-1])]
        found |= {"frames": len(stamps), "first_seconds": times[0], "last_seconds": times[1], "colors": track.colors}
        found["turned"] = _turned(track)
    elif isinstance(stored, ImageSource):
        places = [place for place, file in enumerate(stored.files[name]) if file is not None]
        found |= {"frames": len(places)}
        found |= {"first_seconds": places[0] / stored.fps, "last_seconds": places[-1] / stored.fps}
        found["colors"] = next(file.suffix for file in stored.files[name] if file is not None)
        turn = stored.turns.get(name, 1)
        found["turned"] = "no" if turn == 1 else f"EXIF {turn}"
    return found


def _turned(track: "VideoTrack") -> str:
    return f"{90 * track.quarter_turns} degrees" if track.quarter_turns else "no"


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Warnings of the readers, as text, which are not printed meanwhile."""
    found: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(record.getMessage())

    handler, logger = Collector(logging.WARNING), logging.getLogger("structgstream")
    propagates, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield found
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagates
