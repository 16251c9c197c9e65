# SPDX-License-Identifier: Apache-2.0
"""``reconstruct --qualities``: several qualities of one stream, of the same frames."""

from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from typing import TYPE_CHECKING

from rich.console import Console

from structgstream.cli.app import Interrupted, UsageError, usage_errors
from structgstream.cli.live_run import monitored, run_metrics, stop_of, stop_on_interrupt
from structgstream.cli.progress import print_lines
from structgstream.cli.reconstruct import OpenedScene, Reconstruct, open_scene
from structgstream.cli.signals import Terminated, Termination

if TYPE_CHECKING:
    from structgstream.qualities.ladder import Quality
    from structgstream.recorder import Storage
    from structgstream.scene.scene import Scene
    from structgstream.session.presets import StreamConfig


class _Asked:
    """Whether Ctrl-C was pressed while a recording is reconstructed."""

    def __init__(self) -> None:
        self.stopped = False

    def stop(self) -> None:
        """Notes it."""
        self.stopped = True


def reconstruct(options: Reconstruct, config: "StreamConfig", *, preset: str) -> None:
    """Reconstructs in the qualities of the options, with a progress display.

    Raises:
        UsageError: options that several qualities do not have, or that contradict each other.
        Interrupted: Ctrl-C; all qualities have the frame that was being fitted, unless it was pressed twice.
        Terminated: SIGTERM; as after Ctrl-C.
        StructGStreamError: any other error; whole frames stay.
    """
    if options.quality is not None or options.mbits is not None:
        got = "--quality" if options.mbits is None else "--mbits"
        raise UsageError(
            f"--qualities has a Q for each quality, got {got} besides, which is for one stream; leave {got} out."
        )
    from structgstream.qualities.ladder import configured, qualities_in

    with usage_errors():
        qualities = qualities_in(options.qualities or ())
        for quality in qualities:
            configured(config, quality)
    console, names = Console(), [quality.name for quality in qualities]
    opened = open_scene(options, config, preset=preset, console=console)
    folders = options.segments.quality_folders(
        options.output, names, resume=options.resume, overwrite=options.overwrite
    )
    storages = {name: storage(opened.captured) for name, storage in folders.items()}
    _run(options, config, qualities, opened=opened, storages=storages)
    print_lines(console, f"Wrote {options.output}: {', '.join(names)}")


def _run(
    options: Reconstruct,
    config: "StreamConfig",
    qualities: "Sequence[Quality]",
    *,
    opened: OpenedScene,
    storages: "Mapping[str, Storage[Scene]]",
) -> None:
    from structgstream.data.source import frame_count
    from structgstream.qualities.recording import record_qualities

    source, output = opened.source, options.output
    total, metrics = frame_count(source), run_metrics(source, output, qualities=[one.name for one in qualities])
    run = record_qualities(
        output,
        source,
        config,
        qualities,
        opened.backend,
        storages=storages,
        resume=options.resume,
        metadata=opened.metadata,
        on_step=lambda step: progress.step(step),  # Created below, because it needs the number of existing frames.
        metrics=metrics,
    )
    done, pressed = run.done, _Asked()
    try:
        with (
            Termination(on_ask=stop_of(source)) as ending,
            monitored(source, metrics, done=done) as progress,
            nullcontext() if total is None else stop_on_interrupt(pressed),  # Live cameras are stopped by themselves.
            closing(run.reports) as reports,
        ):
            for one in reports:
                progress.frame(one.report, quality=one.quality)
                done = one.report.index + 1 if one.whole else done
                if one.whole and (ending.asked or pressed.stopped):
                    break
        if done != total and (ending.asked or pressed.stopped):
            raise Terminated if ending.asked else KeyboardInterrupt
    except KeyboardInterrupt as error:
        of = "" if total is None else f" of {total}"
        message = f"{output} has {done}{of} frames in all qualities; continue with the same command and --resume."
        raise (Terminated if isinstance(error, Terminated) else Interrupted)(message) from None
