# SPDX-License-Identifier: Apache-2.0
"""``structgstream prepare`` and ``board``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from structgstream.cli.app import UsageError, interruptible, interruption, usage_errors
from structgstream.cli.options import Flag, Folder, check_ending, parse_options, shown_as
from structgstream.cli.progress import StepDisplay, print_lines

if TYPE_CHECKING:
    from structgstream.pose_check.check import Finding
    from structgstream.preparation.options import PrepareOptions


@dataclass(frozen=True)
class Prepare:
    """Turns videos of still cameras into a calibrated capture, and checks it.

    FOLDER holds CAMERA.mp4, CAMERA/anything.mp4, CAMERA/FRAME.jpg or CAMERA.jpg. The cameras are synchronised and
    calibrated (structure from motion, a board, or a calibration file in FOLDER), and CAPTURE gets links to the videos,
    the calibration, initial points and a report: CAPTURE/report/index.html. Nothing is re-encoded; lenses are
    undistorted when frames are read. After Ctrl-C, or with other options, the same command does what is missing.

    With --check, checks a capture of any layout, writes its report, and exits with status 1 and one sentence when
    it finds an error. See docs/captures.md.

    Example: structgstream prepare videos -o capture --held-out auto

    Example: structgstream prepare videos -o capture --calibration board --board-videos board-takes

    Example: structgstream prepare --check capture
    """

    videos: tyro.conf.Positional[Folder]
    """The folder of the cameras' videos or pictures; with --check, the capture."""
    output: Annotated[Path | None, shown_as("CAPTURE", "-o")] = None
    """The folder to make."""
    check: Flag = False
    """Only check a capture."""
    calibration: Annotated[str, shown_as("auto|sfm|board|PATH")] = "auto"
    """Structure from motion, a board, or the calibration of another tool (file or folder). Default: such a file in
    FOLDER, else sfm."""
    lens: Annotated[Literal["pinhole", "radial", "opencv", "brown", "fisheye"] | None, shown_as()] = None
    """Distortion to estimate; brown for phones. Default: radial by sfm, opencv by board."""
    intrinsics: Literal["own", "shared"] = "own"
    """Whether cameras share focal length and lens (sfm)."""
    refine: Flag = False
    """Adjust the calibration to the pictures, if matches that were set aside then fit better."""
    board: Annotated[str | None, shown_as("BOARD")] = None
    """The board, as structgstream board named it: COLUMNSxROWS:SQUARE, such as 7x5:50mm. Default: 7x5:50mm."""
    board_videos: Annotated[Path | None, shown_as("FOLDER")] = None
    """Videos in which the board is shown to the cameras. Default: those of FOLDER."""
    distance: Annotated[tuple[str, str, str] | None, shown_as("A B LENGTH")] = None
    """Measured distance between the lenses of two cameras, such as 3.2m: the capture then is in metres."""
    synchronize: Annotated[Literal["auto", "csv", "stamps", "audio", "motion", "none"], shown_as()] = "auto"
    """How clocks are found: by timestamps.csv beside the videos, the files' own times, sound, motion, or not at all
    (one signal starts all cameras). Default: csv if it is there, else sound, else motion."""
    field_of_view: Annotated[float | None, shown_as("DEGREES")] = None
    """Across the undistorted pictures. Default: the largest without black borders, up to 110."""
    size: Annotated[str | None, shown_as("WxH")] = None
    """Size of the undistorted pictures. Default: the size of the videos."""
    held_out: Annotated[tuple[str, ...], shown_as("auto|none|CAMERA [CAMERA ...]")] = ("none",)
    """Cameras that are not trained on, so that evaluate can score them; auto takes the one best surrounded by others.
    Default: none."""
    near: Annotated[float | None, shown_as()] = None
    """Distance of the near plane, in units of the capture. Default: half of the depth of the nearest points."""
    fps: Annotated[float | None, shown_as()] = None
    """Frames a second of folders of pictures. Default: 30."""
    without: Annotated[tuple[str, ...], shown_as("CAMERA [CAMERA ...]")] = ()
    """Cameras to leave out."""
    roving: Annotated[Path | None, shown_as("VIDEO")] = None
    """A video of the set by a camera that is carried through it: it connects cameras that see too little in common, and
    gives frame 0 more views of what stands still."""
    link: Literal["hard", "symlink", "copy"] = "hard"
    """How videos get into the capture; hard links need no room, and become copies on another file system."""
    report: Annotated[Path | None, shown_as("FOLDER")] = None
    """With --check: folder of the report, new or that of an earlier one. Default: FOLDER/report."""


def main(arguments: list[str]) -> None:
    """Prepares or checks, with a display of the steps."""
    options = parse_options(Prepare, "prepare", arguments=arguments)
    check_ending(options.output, command="prepare", folder=True)
    check_ending(options.report, command="prepare", option="--report", folder=True)
    if options.check and options != Prepare(options.videos, check=True, report=options.report):
        raise UsageError("--check looks at a capture that is there, so of the other options it takes --report alone.")
    if not options.check and options.output is None:
        raise UsageError("prepare needs the folder to make: -o CAPTURE (or --check to look at a capture).")
    if not options.check and options.report is not None:
        raise UsageError("--report goes with --check; without it the report is CAPTURE/report.")
    console = Console()
    findings = _check(options, console) if options.check else _prepare(options, console)
    _conclude(findings, console)


def _prepare(options: Prepare, console: Console) -> "Sequence[Finding]":
    assert options.output is not None, "checked before"
    from structgstream.preparation.prepare import prepare_capture

    with usage_errors():
        chosen = _chosen(options)
    ended = "Completed steps remain; continue with the same command."
    with interruption(lambda: ended), interruptible(), StepDisplay(console) as display:
        made = prepare_capture(options.videos, options.output, options=chosen, listener=display)
    print_lines(console, f"Capture: {made.path}", f"Report: {made.report}")
    return made.findings


def _check(options: Prepare, console: Console) -> "Sequence[Finding]":
    from structgstream.data.camera_files import REPORT
    from structgstream.preparation.prepare import check_folder

    folder = options.videos / REPORT if options.report is None else options.report
    with interruptible(), StepDisplay(console) as display:
        checked = check_folder(options.videos, report=folder, listener=display)
    print_lines(console, f"Report: {folder / 'index.html'}")
    return checked.report.findings


AS_THEY_ARE = (
    "lens", "intrinsics", "refine", "board_videos", "synchronize", "field_of_view", "near", "fps", "without", "link",
    "roving",
)  # fmt: skip
"""Options that are those of preparation."""


def _chosen(options: Prepare) -> "PrepareOptions":
    from structgstream.preparation.calibration.board import Board
    from structgstream.preparation.options import METHODS, PrepareOptions, parse_board, parse_distance, parse_size

    return PrepareOptions(
        calibration=options.calibration if options.calibration in METHODS else Path(options.calibration).expanduser(),
        board=Board() if options.board is None else parse_board(options.board),
        distance=None if options.distance is None else parse_distance(*options.distance),
        size=None if options.size is None else parse_size(options.size),
        held_out=() if options.held_out == ("none",) else options.held_out,
        **{name: getattr(options, name) for name in AS_THEY_ARE},
    )


def _conclude(findings: "Sequence[Finding]", console: Console) -> None:
    """Prints what is wrong; the worst is an error."""
    from structgstream.errors import CaptureError

    worst = next((finding for finding in findings if finding.severity == "error"), None)
    print_lines(console, *(f"{one.severity}: {one.sentence}" for one in findings if one is not worst))
    if worst is not None:
        raise CaptureError(worst.sentence)
    warned = any(finding.severity == "warning" for finding in findings)
    found = "no error; see the warnings" if warned else "nothing that would spoil a stream"
    print_lines(console, f"The check found {found}.")


@dataclass(frozen=True)
class BoardCommand:
    """Writes a calibration board to print: a ChArUco board in its exact size, as PDF.

    Print it at 100 %, check the bar on it with a ruler, glue it to something flat, and show it slowly to all cameras,
    so that each sees it large and neighbours see it together. Then: structgstream prepare VIDEOS -o CAPTURE
    --calibration board.

    Example: structgstream board -o board.pdf

    Example: structgstream board -o board.pdf --paper A2 --square 80mm
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.pdf")]
    """The file to write."""
    paper: Literal["A4", "A3", "A2", "A1", "A0", "letter", "tabloid"] = "A3"
    """The page."""
    squares: Annotated[str, tyro.conf.arg(metavar="COLUMNSxROWS")] = "7x5"
    """Squares across and down."""
    square: Annotated[str, tyro.conf.arg(metavar="LENGTH")] = "50mm"
    """Side of a square."""
    dictionary: Annotated[str, tyro.conf.arg(metavar="NAME")] = "DICT_5X5_100"
    """Markers: one of OpenCV's predefined dictionaries."""


def board(arguments: list[str]) -> None:
    """Writes the board and says how to name it to prepare."""
    options = parse_options(BoardCommand, "board", arguments=arguments)
    check_ending(options.output, ".pdf", command="board")
    from structgstream.preparation.calibration.board import write_board_pdf
    from structgstream.preparation.options import board_text, parse_board

    with usage_errors():
        board = parse_board(f"{options.squares}:{options.square}:{options.dictionary}")
        write_board_pdf(options.output, board, options.paper)
    print_lines(
        Console(),
        f"Wrote {options.output}: {board.text}, on {options.paper}. Print it at 100 %, and check its bar with a ruler.",
        f"Then: structgstream prepare VIDEOS -o CAPTURE --calibration board --board {board_text(board)}",
    )
