# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and how they are parsed."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from structgstream.cli.app import UsageError, usage_errors

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource
    from structgstream.presets import StreamConfig

Options = TypeVar("Options")
Device = Literal["auto", "cpu", "cuda", "reference"]
Folder = Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
StreamFile = Annotated[Path, tyro.conf.arg(metavar="STREAM")]
Flag = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
JsonPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)


@dataclass(frozen=True)
class CaptureOptions:
    """Options that select the part of a capture, and its picture size."""

    held_out: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="CAMERA [CAMERA ...]", help_behavior_hint="")] = (
        None
    )
    """Cameras to keep from training; auto: the one best surrounded by others. Default: those that the layout holds
    out."""
    scale: float = 1.0
    """Size of the pictures relative to the stored ones, in (0, 1]."""
    start: int = 0
    """First frame to use."""
    frames: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Number of frames. Default: all."""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Use every N-th frame, from the first; the frames a second are divided by N."""
    near: Annotated[float | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Distance of the near plane, in units of the capture. Default: the capture's own, else 0.12 times the
    largest distance of a training camera to their centre."""


PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif")
VIDEOS = (".mp4", ".m4v", ".mov", ".webm", ".mkv", ".avi", ".mpg", ".ts")
OTHER_MEDIA = frozenset({*PICTURES, *VIDEOS, ".html", ".ply", ".splat", ".spz"})
"""Endings of pictures, videos and exports, of which a command writes some."""


def check_ending(output: Path, *endings: str, command: str) -> None:
    """Check that a name does not ask for a kind of file that the command does not write.

    Args:
        output: the file or folder to write.
        endings: of :data:`OTHER_MEDIA`, those that the command writes.
        command: for the message.

    Raises:
        UsageError: it does, or it is "-" or begins with "~", which only a shell resolves.
    """
    if str(output) == "-" or (output.parts[:1] and output.parts[0].startswith("~")):
        raise UsageError(f"-o {output} would be a file or folder of that very name; give a path.")
    if (ending := output.suffix.lower()) in OTHER_MEDIA.difference(endings):
        written = f"it writes {', '.join(endings)}, or" if endings else "it writes a stream, .sgs, or"
        raise UsageError(f"{command} writes no {ending}, got -o {output}; {written} a folder for another name.")


def parse_options(kind: type[Options], command: str, *, arguments: list[str]) -> Options:
    """The options of a command; prints and exits on ``--help`` or wrong usage."""
    return tyro.cli(kind, prog=f"structgstream {command}", args=arguments, config=STYLE)


def parse_known_options(kind: type[Options], command: str, *, arguments: list[str]) -> tuple[Options, list[str]]:
    """As :func:`parse_options`, and the arguments that are no options of the command itself."""
    return tyro.cli(kind, prog=f"structgstream {command}", args=arguments, config=STYLE, return_unknown_args=True)


def resolve_config(
    preset: str | None, overrides: list[str], *, command: str, seed: int | None
) -> tuple["StreamConfig", str]:
    """The preset with the fields set on the command line by their path (``--online.iterations 50``), and its name.

    Raises:
        UsageError: there is no such preset, or the seed is negative.
    """
    from structgstream.presets import DEFAULT_PRESET, StreamConfig, preset_named

    name = DEFAULT_PRESET if preset is None else preset
    with usage_errors():
        default = preset_named(name)
    description = f"Fields of the configuration, with the values of the preset {name!r} as defaults."
    with usage_errors():
        config = tyro.cli(
            StreamConfig,
            prog=f"structgstream {command}",
            description=description,
            default=default,
            args=overrides,
            config=(tyro.conf.FlagConversionOff,),
        )
        return (config if seed is None else replace(config, seed=seed)), name


def open_selected_capture(scene: Path, options: CaptureOptions) -> "FrameSource":
    """The part of a capture that the options select."""
    from structgstream.data.open import open_capture

    return open_capture(
        scene,
        held_out=options.held_out,
        scale=options.scale,
        start=options.start,
        frames=options.frames,
        near=options.near,
        every=options.every,
    )
