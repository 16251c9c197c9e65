# SPDX-License-Identifier: Apache-2.0
"""What ``structgstream prepare --check`` finds in captures that were spoiled on purpose.

``python -m lab.recovery.checking CAPTURE [CAPTURE ...] --json build/checking.json`` checks each capture as it is,
and with each mistake of ``MISTAKES`` made in one of its cameras or in all; ``python -m lab.recovery.checking table
FILE`` prints a result as Markdown. Nothing is written into the captures.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from structgstream.cameras import Camera, CameraRig, rig_radius
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource, SourceWrapper, WithRig, every_nth_frame, section
from structgstream.frames import MultiViewFrame
from structgstream.pose_check.check import Finding
from structgstream.pose_check.verdicts import judge
from structgstream.preparation.checking.check import Examination, check_capture, examine_capture

Cameras = dict[str, Camera]
TRUE_OF_ALL = ("Exposure differs", "White balance differs", "have no matches with", "other camera only", "lacks ",
               "ends with frame", "No two of the")  # fmt: skip
"""Beginnings or parts of sentences about how a capture was filmed, which a mistake neither makes nor hides."""


@dataclass(frozen=True)
class Mistake:
    """Something that is made wrong, and what should be said of it.

    Args:
        what: in a few words.
        change: makes it in the cameras; the name is that of the camera to be spoiled, the number the rig's radius.
        told: a regular expression of the sentence that finds it.
        size: a regular expression with the stated size as its only group; empty where there is none.
        true: the true size in the unit of ``size``; by a camera's distance from the scene in rig radii.
        everyone: whether it is a mistake of all cameras.
        frames: by how many frames the pictures of the camera are late, instead of ``change``.
    """

    what: str
    change: Callable[[Cameras, str, float], None] = lambda cameras, name, radius: None
    told: str = ""
    size: str = ""
    true: Callable[[float], float] = lambda distance: 0.0
    everyone: bool = False
    frames: float = 0.0


def turned(degrees: float) -> Callable[[Cameras, str, float], None]:
    """The camera panned."""

    def change(cameras: Cameras, name: str, radius: float) -> None:
        angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
        turn = torch.eye(4, dtype=torch.float64)
        turn[0, 0] = turn[2, 2] = angle.cos()
        turn[0, 2], turn[2, 0] = angle.sin(), -angle.sin()
        cameras[name] = replace(cameras[name], viewmat=turn @ cameras[name].viewmat)

    return change


def moved(share: float) -> Callable[[Cameras, str, float], None]:
    """The camera moved to its side by a share of the rig's radius."""

    def change(cameras: Cameras, name: str, radius: float) -> None:
        viewmat = cameras[name].viewmat.clone()
        viewmat[0, 3] -= share * radius
        cameras[name] = replace(cameras[name], viewmat=viewmat)

    return change


def focal(factor: float) -> Callable[[Cameras, str, float], None]:
    """Another focal length."""

    def change(cameras: Cameras, name: str, radius: float) -> None:
        K = cameras[name].K.clone()
        K[0, 0], K[1, 1] = K[0, 0] * factor, K[1, 1] * factor
        cameras[name] = replace(cameras[name], K=K)

    return change


def exchanged(cameras: Cameras, name: str, radius: float) -> None:
    """The calibrations of two cameras; the other one is the first, or of that the second."""
    other = next(each for each in cameras if each != name)
    one, two = cameras[name], cameras[other]
    cameras[name], cameras[other] = (
        replace(one, viewmat=two.viewmat, K=two.K),
        replace(two, viewmat=one.viewmat, K=one.K),
    )


def of_all(change: Callable[[Camera], Camera]) -> Callable[[Cameras, str, float], None]:
    """A change of all cameras."""

    def every(cameras: Cameras, name: str, radius: float) -> None:
        for each in cameras:
            cameras[each] = change(cameras[each])

    return every


def inverted(camera: Camera) -> Camera:
    """Camera to world in place of world to camera."""
    return replace(camera, viewmat=torch.linalg.inv(camera.viewmat))


def opengl(camera: Camera) -> Camera:
    """y up and z backward."""
    return replace(
        camera, viewmat=torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)) @ camera.viewmat
    )


def farther(camera: Camera) -> Camera:
    """Millimetres for metres, the near plane not."""
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] *= 1000
    return replace(camera, viewmat=viewmat)


def of_half_size(camera: Camera) -> Camera:
    """Intrinsics of pictures of half the size."""
    return replace(camera, K=camera.K * torch.tensor([[0.5], [0.5], [1.0]], dtype=torch.float64))


def of_one(change: Callable[[Camera], Camera]) -> Callable[[Cameras, str, float], None]:
    """A change of one camera."""

    def single(cameras: Cameras, name: str, radius: float) -> None:
        cameras[name] = change(cameras[name])

    return single


DEGREES, SHARE, FOCAL, LATE = r"place it ([\d.]+) degrees", r"([\d.]+)% \(± [\d.]+%\) of its distance", \
    r"focal length ([\d.]+)%", r"is [\d.]+ ms \(([\d.]+) frames\)"  # fmt: skip
MISTAKES = (
    Mistake("turned by 0.3 degrees", turned(0.3), " is off: ", DEGREES, lambda distance: 0.3),
    Mistake("turned by 1 degree", turned(1.0), " is off: ", DEGREES, lambda distance: 1.0),
    Mistake("moved by 1 % of the radius", moved(0.01), " is off: ", SHARE, lambda distance: 1.0 / distance),
    Mistake("focal length 2 % longer", focal(1.02), " is off: ", FOCAL, lambda distance: 2.0),
    Mistake("exchanged with another", exchanged, "are exchanged"),
    Mistake("its pose inverted", of_one(inverted), "has its pose inverted"),
    Mistake("its position in millimetres", of_one(farther), "millimetres among metres"),
    Mistake("its intrinsics of half the size", of_one(of_half_size), "has intrinsics of a picture of"),
    Mistake("all poses inverted", of_all(inverted), "camera to world in place of", everyone=True),
    Mistake("all in OpenGL axes", of_all(opengl), "OpenGL axes", everyone=True),
    Mistake("all positions in millimetres, not the near plane and points", of_all(farther), "metres", everyone=True),
    Mistake("all intrinsics of half the size", of_all(of_half_size), "of one picture size", everyone=True),
    Mistake("half a frame late", told=" ms ", size=LATE, true=lambda distance: 0.5, frames=0.5),
    Mistake("a frame late", told=" ms ", size=LATE, true=lambda distance: 1.0, frames=1.0),
    Mistake("three frames late", told=" ms ", size=LATE, true=lambda distance: 3.0, frames=3.0),
)


@dataclass(frozen=True)
class Late(SourceWrapper):
    """A capture of which one camera's pictures are those of ``frames`` frames before."""

    camera: str
    frames_late: int

    def __len__(self) -> int:
        return len(self.source) - self.frames_late

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        shift = self.frames_late
        pairs = zip(self.source.frames(start + shift), self.source.frames(start), strict=False)
        for index, (frame, before) in enumerate(pairs, start):
            images = dict(frame.images)
            images.pop(self.camera, None)
            if self.camera in before.images:
                images[self.camera] = before.images[self.camera]
            yield replace(frame, index=index, pts_seconds=index / self.fps, images=images)


@dataclass(frozen=True)
class HalfRate(SourceWrapper):
    """Every second frame, of one camera the frames between, which are earlier by half of the new period."""

    camera: str

    @property
    def fps(self) -> float:
        return self.source.fps / 2

    def __len__(self) -> int:
        return (len(self.source) - 1) // 2

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        early, late = (every_nth_frame(section(self.source, start=first), 2) for first in (0, 1))
        for index, (before, frame) in enumerate(zip(early.frames(start), late.frames(start), strict=False), start):
            images = dict(frame.images)
            images.pop(self.camera, None)
            if self.camera in before.images:
                images[self.camera] = before.images[self.camera]
            yield replace(frame, index=index, pts_seconds=index / self.fps, images=images)


def checks(path: Path, label: str, only: str = "") -> list[dict[str, Any]]:
    """Rows of a capture: as it is, and with each mistake."""
    source = open_capture(path)
    found = examine_capture(source)
    # One that the check can say something of: it stands in the middle and has matches.
    overlapping = found.evidence.overlapping()
    name = max(source.rig, key=lambda name: sum(name in pair for pair in overlapping))
    distance, radius = _distance(found, name)
    rows = [_row(label, "as it is", None, check_capture(source, examination=found).report.findings, name, distance)]
    print(as_table(rows), flush=True)
    for mistake in MISTAKES:
        if not re.search(only, mistake.what):
            continue
        if mistake.frames:
            findings = _late(source, mistake, name, found)
        else:
            findings = _spoiled(source, mistake, name, found, radius)
        rows.append(_row(label, mistake.what, mistake, findings, name, distance))
        print(as_table(rows[-1:]), flush=True)
    return rows


def _spoiled(
    source: FrameSource, mistake: Mistake, name: str, found: Examination, radius: float
) -> tuple[Finding, ...]:
    """The check of one frame under other cameras; matches do not depend on them."""
    cameras = dict(source.rig.cameras)
    mistake.change(cameras, name, radius)
    spoiled = WithRig(section(source, start=found.frame.index, frames=1), source.rig.mapped(cameras))
    seen = {each: cameras[each] for each in found.cameras}
    examination = replace(
        found,
        frame=replace(found.frame, index=0),
        cameras=seen,
        verdict=judge(found.evidence, seen),
        presence={each: np.ones(1, bool) for each in cameras},
    )
    return check_capture(spoiled, unit="metres", examination=examination).report.findings


def _late(source: FrameSource, mistake: Mistake, name: str, found: Examination) -> tuple[Finding, ...]:
    late = HalfRate(source, name) if mistake.frames == 0.5 else Late(source, name, round(mistake.frames))
    return check_capture(late).report.findings


def _distance(found: Examination, name: str) -> tuple[float, float]:
    """Median distance of a camera to the points that it sees, in rig radii, and the radius."""
    radius = rig_radius(CameraRig(dict(found.cameras)))
    tracks, center = found.tracks, found.cameras[name].center.numpy()
    points = tracks.points[tracks.point[tracks.of(name)]]
    return float(np.median(np.linalg.norm(points - center, axis=1))) / radius, radius


def _row(
    label: str, what: str, mistake: Mistake | None, findings: Iterable[Finding], name: str, distance: float
) -> dict[str, Any]:
    said = [found for found in findings if found.severity != "note"]
    said = [found for found in said if not any(part in found.sentence for part in TRUE_OF_ALL)]
    hits = [] if mistake is None else [found for found in said if _is_hit(found, mistake, name)]
    row: dict[str, Any] = {
        "capture": label,
        "what": what,
        "camera": None if mistake is None or mistake.everyone else name,
        "hit": None if mistake is None else bool(hits),
        "others": [found.sentence for found in said if found not in hits],
        "notes": [found.sentence for found in findings if found.severity == "note"],
        "sentence": hits[0].sentence if hits else "",
    }
    if mistake is not None and mistake.size:
        row["true"] = mistake.true(distance)
        stated = re.search(mistake.size, row["sentence"])
        row["stated"] = float(stated.group(1)) if stated else None
    return row


def _is_hit(found: Finding, mistake: Mistake, name: str) -> bool:
    return bool(re.search(mistake.told, found.sentence)) and (mistake.everyone or name in found.cameras)


def as_table(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows as Markdown, without a head."""
    lines = []
    for row in rows:
        verdict = "" if row["hit"] is None else "found" if row["hit"] else "**missed**"
        stated = "" if row.get("stated") is None else f"{row['stated']:g}"
        true = "" if row.get("true") is None else f"{row['true']:.2g}"
        others = f"{len(row['others'])}" if row["others"] else ""
        lines.append(f"| {row['capture']} | {row['what']} | {verdict} | {true} | {stated} | {others} |")
    return "\n".join(lines)


def table(result: Mapping[str, Any]) -> str:
    """A result as Markdown: one line for each mistake, with what was found in each capture."""
    rows = result["rows"]
    captures = list(dict.fromkeys(row["capture"] for row in rows))
    lines = [f"| what is made wrong | {' | '.join(captures)} |", "|---" * (1 + len(captures)) + "|"]
    for what in dict.fromkeys(row["what"] for row in rows):
        cells = {row["capture"]: _cell(row) for row in rows if row["what"] == what}
        lines.append(f"| {what} | {' | '.join(cells.get(capture, '') for capture in captures)} |")
    machine = result["machine"]
    foot = f"`{result['command']}`, {machine['cpu']}, commit {machine['commit']}"
    return "\n".join([*lines, "", foot])


def _cell(row: Mapping[str, Any]) -> str:
    told = "" if row["hit"] is None else "found" if row["hit"] else "missed"
    if row.get("stated") is not None:
        told = f"{row['stated']:g} of {row['true']:.2g}"
    count = len(row["others"])
    more = f"{count} {'more' if told else 'said'}" if count else "" if told else "nothing"
    return ", ".join(part for part in (told, more) if part)


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m lab.recovery.checking",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("captures", nargs="+", help="a folder, or LABEL=folder")
    parser.add_argument("--json", type=Path, help="file to write; rows of other captures that it has are kept")
    parser.add_argument("--only", default="", help="mistakes whose name this regular expression finds")
    return parser.parse_args(arguments)


def main() -> None:
    """Checks, or prints a result as Markdown."""
    if sys.argv[1:2] == ["table"]:
        for path in sys.argv[2:]:
            print(table(json.loads(Path(path).read_text())))
        return
    from benchmarks.machine import machine

    options = parsed()
    command = " ".join(["python -m lab.recovery.checking", *sys.argv[1:]])
    result: dict[str, Any] = {"command": command, "machine": machine(), "rows": []}
    named = [given.rsplit("=", 1) if "=" in given else [Path(given).name, given] for given in options.captures]
    if options.json and options.json.is_file():
        labels = [label for label, _ in named]
        result["rows"] = [row for row in json.loads(options.json.read_text())["rows"] if row["capture"] not in labels]
    for label, path in named:
        result["rows"] += checks(Path(path), label, options.only)
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
