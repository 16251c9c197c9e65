# SPDX-License-Identifier: Apache-2.0
"""What ``structgstream prepare`` recovers of rigs with known truth (``lab/rigs``).

``python -m lab.recovery.preparation build/rigs [RIG ...] --work build/prepared --json lab/results/preparation.json``
prepares every rig, holds cameras and clocks against the truth, and makes two short streams with the same settings, one
from the prepared capture and one from the same videos with the true calibration; their held-out PSNR is compared, the
mean over ``--seeds``. ``--how`` takes one of a rig's preparations, ``--keep`` the captures that ``--work`` has already.
``python -m lab.recovery.preparation table FILE`` prints a result as Markdown.
"""

import argparse
import json
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import print_tables
from lab.recovery.exact import stream_scores, write_exact
from lab.recovery.recovery import camera_errors, plain, summary
from lab.rigs.truth import Truth, read_truth
from structgstream.data.lenses import LensCamera
from structgstream.data.prepared import PreparedCapture, read_prepared
from structgstream.data.timeline import Clock
from structgstream.errors import StructGStreamError
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.footage import Footage, find_footage
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.prepare import prepare_capture
from structgstream.session.presets import FAST, StreamConfig

FIELD_OF_VIEW_DEGREES, SIZE = 50.0, (320, 240)  # of both captures, so that their held-out pictures show the same
SEED_POINTS = "points.npy"

SHORT: StreamConfig = replace(
    FAST,
    initial=replace(
        FAST.initial,
        iterations=500,
        schedule_iterations=500,
        coarse_iterations=350,
        growth=replace(FAST.initial.growth, collect_from=40, start=80, stop=400, room_until=300),
    ),
    online=replace(FAST.online, iterations=40, patching=replace(FAST.online.patching, iteration=20)),
)
"""As the preset ``fast`` with less than half of its iterations."""


@dataclass(frozen=True)
class Run:
    """One preparation.

    Args:
        rig: whose videos.
        how: in a few words, for tables.
        options: what is asked for, beside size, field of view and the held-out camera.
    """

    rig: str
    how: str
    options: PrepareOptions = PrepareOptions()


OPTIONS: Mapping[str, Mapping[str, PrepareOptions]] = {
    "mild": {"sfm": PrepareOptions(), "sfm, shared": PrepareOptions(intrinsics="shared")},
    "phone": {"sfm": PrepareOptions(), "sfm, brown": PrepareOptions(lens="brown")},
    "fisheye": {"sfm, fisheye": PrepareOptions(lens="fisheye")},
    "bumped": {"sfm": PrepareOptions(), "sfm, without cam04": PrepareOptions(without=("cam04",))},
}
"""What is asked for beside size, field of view and the held-out camera, by rig and in a few words."""

BOARD_OPTIONS: Mapping[str, Mapping[str, PrepareOptions]] = {
    "phone-board": {"board, brown": PrepareOptions(lens="brown")},
}
"""The same for rigs with a board, beside the board itself."""


def runs(folder: Path, rigs: list[str]) -> list[Run]:
    """The preparations of these rigs, each as a user of that rig would ask for it."""
    found = []
    for rig in rigs:
        truth, here = read_truth(folder / rig), folder / rig
        if truth.given is not None:
            given = PrepareOptions(calibration=here / "calibration.json")
            asked = {"its calibration": given, "its calibration, refined": replace(given, refine=True)}
        elif truth.board is not None:
            videos = here / "board" if truth.held_out is not None else None
            options = PrepareOptions(calibration="board", board=Board(**truth.board), board_videos=videos)
            asked = {"board": options, **BOARD_OPTIONS.get(rig, {})}
            asked = {name: replace(options, lens=other.lens) for name, other in asked.items()}
        else:
            asked = OPTIONS.get(rig, {"sfm": PrepareOptions()})
        how = synchronization(truth)
        found += [Run(rig, name, replace(options, synchronize=how)) for name, options in asked.items()]
    return found


def synchronization(truth: Truth) -> str:
    """What the owner of a rig would ask for: nothing where one signal starts all cameras."""
    return "none" if set(true_clocks(truth).values()) == {Clock()} else "auto"


def measured(
    run: Run, folder: Path, work: Path, *, frames: int, seeds: Sequence[int], keep: bool = False
) -> dict[str, Any]:
    """One preparation against the truth, as plain JSON values; what fails is told in its ``error``.

    Args:
        run: what is prepared.
        folder: of the rigs.
        work: for captures and streams.
        frames: of each stream.
        seeds: of the streams; none are made without any.
        keep: go on from a capture that is there instead of making it anew.
    """
    truth = read_truth(folder / run.rig)
    videos = folder / run.rig / ("videos" if truth.held_out is not None else "board")
    name = f"{run.rig}-{run.how}".replace(",", "").replace(" ", "-")
    capture = work / name
    if not keep:
        shutil.rmtree(capture, ignore_errors=True)
    options = replace(run.options, field_of_view=FIELD_OF_VIEW_DEGREES, size=SIZE)
    if truth.held_out is not None:
        options = replace(options, held_out=(truth.held_out,))
    found: dict[str, Any] = {"rig": run.rig, "what": truth.what, "how": run.how}
    begun, processor = time.perf_counter(), time.process_time()
    try:
        made = prepare_capture(videos, capture, options=options)
    except StructGStreamError as error:
        return found | {"error": str(error)}
    found |= {
        "seconds": time.perf_counter() - begun,
        "processor_seconds": time.process_time() - processor,
        "steps": dict(made.steps),
        "findings": [{"severity": f.severity, "sentence": f.sentence} for f in made.findings],
    }
    content = read_prepared(capture)
    found |= recovered(content, truth, find_footage(videos))
    if seeds and truth.held_out is not None:
        exact = work / f"{name}-exact"
        write_exact(capture, exact, true_cameras(truth), true_clocks(truth))
        found |= compared_streams({"prepared": capture, "exact": exact}, work, frames=frames, seeds=seeds)
    return found


def compared_streams(
    captures: Mapping[str, Path], work: Path, *, frames: int, seeds: Sequence[int]
) -> dict[str, dict[str, Any]]:
    """PSNR of a short stream of each capture: the mean over the seeds, and each."""
    each = {
        kind: [
            stream_scores(folder, work / f"{folder.name}.sgs", preset=replace(SHORT, seed=seed), frames=frames)["psnr"]
            for seed in seeds
        ]
        for kind, folder in captures.items()
    }
    return {
        "psnr": {
            kind: float(np.mean([value for value in values if value is not None])) for kind, values in each.items()
        },
        "psnr_by_seed": {kind: dict(zip(map(str, seeds), values, strict=True)) for kind, values in each.items()},
    }


def recovered(content: PreparedCapture, truth: Truth, footage: Footage) -> dict[str, Any]:
    """Errors of the cameras of a prepared capture."""
    estimate = {name: camera.filmed for name, camera in content.cameras.items()}
    clocks = {name: camera.clock for name, camera in content.cameras.items()}
    takes = {name: (float(footage.stamps(name)[0]), float(footage.stamps(name)[-1])) for name in estimate}
    errors = camera_errors(estimate, true_cameras(truth), clocks=clocks, true_clocks=true_clocks(truth), takes=takes)
    return {
        "errors": summary(errors),
        "cameras": plain(errors),
        "missing": sorted(set(truth.cameras) - set(estimate)),
    }


def true_cameras(truth: Truth) -> dict[str, LensCamera]:
    """The cameras of a rig, as they stood at first."""
    return {name: camera.filmed for name, camera in truth.cameras.items()}


def true_clocks(truth: Truth) -> dict[str, Clock]:
    """The clocks of a rig."""
    return {name: Clock(camera.offset_seconds, camera.rate) for name, camera in truth.cameras.items()}


def table(result: Mapping[str, Any]) -> str:
    """A result as Markdown."""
    machine = result["machine"]
    lines = [
        f"`{result['command']}`",
        "",
        f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, commit {machine['commit']}; "
        f"streams of {result['frames']} frames of {SIZE[0]}x{SIZE[1]}, {SHORT.initial.iterations} iterations of "
        "frame 0. Errors are medians over the cameras, in brackets the largest.",
        "",
        "| rig | by | rotation, degrees | position, % of the rig's radius | focal length, % | lens, pixels | time, ms "
        "| held-out PSNR, exact | difference | found |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [_row(run) for run in result["runs"]]
    return "\n".join(lines)


def _row(run: Mapping[str, Any]) -> str:
    if "error" in run:
        return f"| {run['what']} | {run['how']} | {run['error']} |" + " |" * 7
    errors = run["errors"]
    digits = {"rotation_degrees": 3, "position_percent": 2, "focal_percent": 2, "lens_pixels": 2, "milliseconds": 1}
    cells = [_median_and_largest(errors[key], places) for key, places in digits.items()]
    psnr = run.get("psnr")
    cells += [f"{psnr['exact']:.2f} dB", f"{psnr['prepared'] - psnr['exact']:+.2f} dB"] if psnr else ["", ""]
    told = " ".join(finding["sentence"] for finding in run["findings"]).replace("|", "\\|")
    return f"| {run['what']} | {run['how']} | " + " | ".join(cells) + f" | {told} |"


def _median_and_largest(error: Mapping[str, float | None], places: int) -> str:
    if error["median"] is None:
        return ""
    return f"{error['median']:.{places}f} ({error['largest']:.{places}f})"


def parsed(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m lab.recovery.preparation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="what lab/rigs/film.py made")
    parser.add_argument("rigs", nargs="*", help="all when none is named")
    parser.add_argument("--work", type=Path, required=True, help="folder for captures and streams")
    parser.add_argument("--json", type=Path, help="file to write; runs of other rigs that it has are kept")
    parser.add_argument("--frames", type=int, default=4, help="of each stream")
    parser.add_argument("--streams", action=argparse.BooleanOptionalAction, default=True, help="compare PSNR")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the streams, whose mean is compared")
    parser.add_argument("--how", nargs="+", help="only preparations that the tables call so")
    parser.add_argument("--keep", action="store_true", help="go on from captures that are in --work")
    return parser.parse_args(arguments)


def main() -> None:
    """Measures, or prints a result as Markdown."""
    if sys.argv[1:2] == ["table"]:
        print_tables(sys.argv[2:], table)
        return
    from benchmarks.machine import machine

    options = parsed()
    rigs = options.rigs or sorted(path.parent.name for path in options.folder.glob("*/truth.json"))
    options.work.mkdir(parents=True, exist_ok=True)
    command = " ".join(["python -m lab.recovery.preparation", *sys.argv[1:]])
    result: dict[str, Any] = {"command": command, "frames": options.frames, "machine": machine(), "runs": []}
    asked = [run for run in runs(options.folder, rigs) if options.how is None or run.how in options.how]
    if options.json and options.json.is_file():
        again = {(run.rig, run.how) for run in asked}
        earlier = json.loads(options.json.read_text())["runs"]
        result["runs"] = [run for run in earlier if (run["rig"], run["how"]) not in again]
    seeds = options.seeds if options.streams else []
    for run in asked:
        result["runs"].append(
            measured(run, options.folder, options.work, frames=options.frames, seeds=seeds, keep=options.keep)
        )
        print(_row(result["runs"][-1]), flush=True)
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
