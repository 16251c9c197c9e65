# SPDX-License-Identifier: Apache-2.0
"""The table of formats, and the options of an export; imports no torch, so that the help of a command is fast."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from structgstream.atomic_files import side_path
from structgstream.errors import ConfigError

Format = Literal["ply", "splat", "spz", "sog", "glb", "usd", "4dgs"]
"""Formats of plain 3D Gaussians."""
PageFormat = Literal["html", "site"]
"""Formats of the whole stream with a player: a single page, or a folder for a web server."""
PAGES: tuple[PageFormat, ...] = get_args(PageFormat)
SpzVersion = Literal[2, 3, 4]
MAX_SH_DEGREE = 3


@dataclass(frozen=True)
class FormatInfo:
    """A row of the table."""

    purpose: str  # what the format is good for
    readers: str  # programs that open it
    max_degree: int = MAX_SH_DEGREE  # highest degree of spherical harmonics
    all_frames: bool = False  # whether one file contains all frames
    suffixes: tuple[str, ...] = ()  # further endings of file names


FORMATS: Mapping[Format, FormatInfo] = {
    "ply": FormatInfo(
        "editing; numbered files are a sequence in SuperSplat",
        "SuperSplat, Brush, Postshot, Blender, Unity and Unreal importers",
    ),
    "splat": FormatInfo("oldest web viewers; one colour a Gaussian", "antimatter15/splat, Spark, Babylon.js", 0),
    "spz": FormatInfo("small files for the web", "Niantic Scaniverse, Spark, Babylon.js, Cesium"),
    "sog": FormatInfo("smallest files for the web", "PlayCanvas, SuperSplat, Spark"),
    "glb": FormatInfo(
        "glTF pipelines (KHR_gaussian_splatting)", "Khronos Sample Renderer, Cesium, Babylon.js, PlayCanvas, three.js"
    ),
    "usd": FormatInfo(
        "film and simulation tools: all frames in one file, as time samples",
        "OpenUSD from 26.03: usdview, Arnold, Omniverse",
        all_frames=True,
        suffixes=("usdc", "usda"),
    ),
    "4dgs": FormatInfo(
        "archive of all frames in one seekable file with an open specification", "fourdgs, 4dgs-viewer", all_frames=True
    ),
}
SUFFIXES: Mapping[str, Format] = {suffix: name for name, info in FORMATS.items() for suffix in (name, *info.suffixes)}
"""Format by the ending of a file's name."""


@dataclass(frozen=True)
class FrameOptions:
    """Options of frames as plain 3D Gaussians."""

    degree: int | None = None  # degree of the spherical harmonics; None for 1, or for 0 in a format without
    low_pass: float = 0.0  # variance by which Gaussians are widened, squared training pixels (bake.with_low_pass)
    # two opposite corners, in the capture's units; Gaussians with means outside are left out
    box: tuple[float, float, float, float, float, float] | None = None
    min_opacity: float = 0.0  # Gaussians below this opacity are left out
    max_splats: int | None = None  # largest number of Gaussians; the smallest and most transparent are left out
    pad_sh: bool = False  # write all 45 f_rest properties of a .ply, which some importers need
    spz_version: SpzVersion = 2

    def check(self, format: Format) -> None:
        """Check the values, and that ``format`` supports them. Raises ConfigError if it does not, or a value is out of
        range."""
        highest = FORMATS[format].max_degree
        if self.degree is not None and not 0 <= self.degree <= MAX_SH_DEGREE:
            raise ConfigError(f"--sh-degree {self.degree} is not one of 0 to {MAX_SH_DEGREE}.")
        if (self.degree or 0) > highest:
            raise ConfigError(f"a .{format} file has one colour per Gaussian; --sh-degree {self.degree} needs another.")
        if not 0.0 <= self.low_pass <= 1.0:
            raise ConfigError(
                f"--low-pass {self.low_pass:g} is no variance in squared training pixels; expected 0 to 1."
            )
        if not 0.0 <= self.min_opacity < 1.0:
            raise ConfigError(f"--min-opacity {self.min_opacity:g} is no opacity; expected 0 to 1, without 1.")
        if self.max_splats is not None and self.max_splats < 1:
            raise ConfigError(f"--max-splats {self.max_splats} leaves no Gaussian; expected 1 or more.")
        if self.box is not None and not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)):
            raise ConfigError("--crop names the lowest x, y, z and then the highest; the box has no volume.")
        if self.pad_sh and format != "ply":
            raise ConfigError(f"--pad-sh is for .ply files, not for .{format}.")
        if self.spz_version != 2 and format != "spz":
            raise ConfigError(f"--spz-version is for .spz files, not for .{format}.")

    def baked_degree(self, format: Format) -> int:
        """The degree to fit."""
        return min(1, FORMATS[format].max_degree) if self.degree is None else self.degree


def destination(
    stream: Path,
    output: Path | None,
    *,
    format: Format | PageFormat | None,
    frame: int | None,
    frames: tuple[int, int] | None,
) -> tuple[Path, Format | PageFormat]:
    """The path to write to, by default next to the stream, and the format, by default that of the suffix, else ``ply``.
    Raises ConfigError if the suffix is no format or differs from ``format``, or both ``frame`` and ``frames`` are
    given."""
    if frame is not None and frames is not None:
        raise ConfigError("--frame names one frame, --frames the first and the last; give one of them.")
    if output is None:
        format = format or "ply"
        if format == "html" or (format != "site" and FORMATS[format].all_frames and frame is None):
            return side_path(stream, f".{format}"), format
        return side_path(stream, f"-{format}" if frame is None else f"-{frame}.{format}"), format
    ending = output.suffix.lower().lstrip(".")
    if format == "html" and (output.is_dir() or ending != "html"):
        raise ConfigError(f"a page is a file whose name ends in .html, unlike {output.name}.")
    if format == "site" or output.is_dir() or not ending:
        return output, format or "ply"
    if ending == "zip" and format != "html":
        if format is not None and FORMATS[format].all_frames:
            raise ConfigError(f"a .{format} file contains all frames; name it {output.stem}.{format}, without a zip.")
        return output, format or "ply"
    known = "html" if ending == "html" else SUFFIXES.get(ending)
    if known is not None:
        if format not in (None, known):
            raise ConfigError(f"the name {output.name} asks for .{ending}, and --format for {format}.")
        return output, known
    if format is None:
        known = ", ".join((*FORMATS, *PAGES))
        raise ConfigError(f"there is no format .{ending}; there are {known}. For a folder of this name add --format.")
    return output, format


def check_page(*, frame: int | None, frames: tuple[int, int] | None, options: FrameOptions) -> None:
    """Check that no options of other formats are given for a page. Raises ConfigError if one is given."""
    if frame is not None or frames is not None or options != FrameOptions():
        raise ConfigError("a page contains the whole stream; choices of frames and of Gaussians are for other formats.")


def choose_frames(
    runs: Sequence[range], output: Path, *, frame: int | None, frames: tuple[int, int] | None
) -> list[int]:
    """Numbers of the frames to write, of the ``runs`` that can be decoded. Raises ConfigError if there is no such
    frame, it is lost, or several would be written into a file that contains one."""
    if not any(runs):
        raise ConfigError("the stream has no whole frame.")
    if frame is None and frames is None:
        numbers = [index for run in runs for index in run]
    else:
        first, last = frames or (frame or 0, frame or 0)
        if first > last:
            raise ConfigError(f"--frames names the first frame, then the last; {first} comes after {last}.")
        if not any(first in run and last in run for run in runs):
            asked = f"frame {first}" if first == last else f"range from {first} to {last}"
            have = " and ".join(f"{run.start} to {run.stop - 1}" for run in runs)
            raise ConfigError(f"the stream has frames {have}; there is no {asked}.")
        numbers = list(range(first, last + 1))
    if is_one_file(output) and len(numbers) > 1:
        raise ConfigError(f"{output.name} contains one frame: choose it with --frame, or name a folder and --format.")
    return numbers


def is_one_file(output: Path) -> bool:
    """Whether ``output`` is a file for one frame."""
    format = SUFFIXES.get(output.suffix.lower().lstrip("."))
    return format is not None and not FORMATS[format].all_frames and not output.is_dir()
