# SPDX-License-Identifier: Apache-2.0
"""``structgstream reconstruct``."""

import time
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from structgstream.cli.app import Interrupted, UsageError
from structgstream.cli.options import (
    CaptureOptions,
    Device,
    Folder,
    opened_capture,
    parsed_with_rest,
    resolved_config,
)
from structgstream.cli.progress import display

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource
    from structgstream.kernels.backend import Backend
    from structgstream.presets import StreamConfig


@dataclass(frozen=True)
class Reconstruct:
    """Turns a capture into a stream, one frame after the other.

    The file can be read while it grows. Ctrl-C keeps the frames that are done; --resume goes on after them. Seconds by
    stage and memory of each frame go to OUT.log.jsonl. Any field of the configuration is an option by its path:
    --online.iterations 50 (see --help-config).

    Example: structgstream reconstruct basketball -o ball.sgs --frames 20 --held-out 0 10 15 30

    Example: structgstream reconstruct basketball -o ball.sgs --preset fast --scale 0.5 --online.iterations 40
    """

    scene: tyro.conf.Positional[Folder]
    """The capture: a folder of one of the known layouts."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT.sgs")]
    """The stream file to write."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """rig (default: any rig), fast (a try in minutes), paper-n3dv, paper-meetroom, paper-immersive, tiny (tests)."""
    device: Device = "auto"
    """What computes; auto takes the first of cuda, cpu, reference that is there."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """Seed of everything random. Default: the preset's."""
    resume: bool = False
    """Go on after the last whole frame of OUT.sgs. The same options give the same file as an uninterrupted run."""
    overwrite: bool = False
    """Replace OUT.sgs when it exists."""
    help_config: bool = False
    """List the fields of the configuration with the preset's values."""
    capture: CaptureOptions = field(default_factory=CaptureOptions)


def main(arguments: list[str]) -> None:
    """Reconstructs with a progress display."""
    if "--help-config" in arguments:
        _print_config_help(arguments)
    options, rest = parsed_with_rest(Reconstruct, "reconstruct", arguments=arguments)
    if options.resume and options.overwrite:
        raise UsageError("--resume keeps the file and --overwrite replaces it: choose one.")
    config = resolved_config(options.preset, rest, command="reconstruct", seed=options.seed)
    from structgstream.kernels.backend import select_backend

    source = opened_capture(options.scene, options.capture)
    backend = select_backend(options.device)
    try:
        reconstructed(
            source,
            config,
            output=options.output,
            backend=backend,
            metadata={"preset": options.preset, "start": options.capture.start, "scale": options.capture.scale},
            resume=options.resume,
            overwrite=options.overwrite,
        )
    except KeyboardInterrupt:
        raise Interrupted(
            f"The frames that are done are in {options.output}; go on with the same command and --resume."
        ) from None
