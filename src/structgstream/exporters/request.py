# SPDX-License-Identifier: Apache-2.0
"""Resolves the destination, format and frames of an export."""

from collections.abc import Sequence
from pathlib import Path

from structgstream.errors import ConfigError
from structgstream.exporters.formats import FORMATS, PAGES, SUFFIXES, Format, FrameOptions, PageFormat


def destination(
    stream: Path,
    output: Path | None,
    *,
    format: Format | PageFormat | None,
    frame: int | None,
    frames: tuple[int, int] | None,
) -> tuple[Path, Format | PageFormat]:
    """The path to write to, and the format.

    Args:
        stream: the stream's file.
        output: the file or folder to write; None for one next to the stream.
        format: the format; None for the suffix of ``output``, else ``ply``.
        frame: the only frame to write, or None.
        frames: the first and the last frame, or None.

    Raises:
        ConfigError: the suffix is not a format or differs from ``format``, or both ``frame`` and ``frames`` are given.
    """
    if frame is not None and frames is not None:
        raise ConfigError("--frame names one frame, --frames the first and the last; give one of them.")
    if output is None:
        format = format or "ply"
        if format == "html" or (format != "site" and FORMATS[format].all_frames and frame is None):
            return stream.with_suffix(f".{format}"), format
        name = f"{stream.stem}-{format}" if frame is None else f"{stream.stem}-{frame}.{format}"
        return stream.with_name(name), format
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
    """Check that no options of other formats are given for a page.

    Raises:
        ConfigError: one is given.
    """
    if frame is not None or frames is not None or options != FrameOptions():
        raise ConfigError("a page contains the whole stream; choices of frames and of Gaussians are for other formats.")


def choose_frames(
    runs: Sequence[range], output: Path, *, frame: int | None, frames: tuple[int, int] | None
) -> list[int]:
    """Numbers of the frames to write.

    Args:
        runs: the frames of the stream that can be decoded.
        output: the destination; a file whose suffix is a format contains one frame.
        frame: the only frame, or None.
        frames: the first and the last frame, or None for all.

    Raises:
        ConfigError: there is no such frame, it is lost, or several would be written into one file.
    """
    if not runs:
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
