# SPDX-License-Identifier: Apache-2.0
"""``reconstruct --live``: its options, opening the cameras, the display, and the end of a run."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Protocol

import tyro

from structgstream.cli.app import UsageError, usage_errors
from structgstream.cli.options import CaptureOptions, Flag
from structgstream.cli.progress import Display, display

if TYPE_CHECKING:
    from structgstream.data.denoising import DenoisingConfig
    from structgstream.data.live.source import LiveSource
    from structgstream.data.source import FrameStream
    from structgstream.run_metrics import RunMetrics


class Stoppable(Protocol):
    """A run that can be stopped after the frame being fitted, such as a ``LiveSource``."""

    @property
    def stopped(self) -> bool:
        """Whether :meth:`stop` was called."""
        ...

    def stop(self) -> None:
        """Stops after this frame; may be called by a signal's handler."""
        ...


@dataclass(frozen=True)
class LiveChoice:
    """Options of live cameras."""

    live: Flag = False
    """FOLDER is a rig file of cameras that send now; what they send while a frame is fitted is skipped. The stream ends
    after --frames, or with Ctrl-C."""
    record: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Live only: record all that the cameras send, as a capture that can be reconstructed with every frame."""

    def check(self, scene: Path) -> None:
        """Check the options of a run that is not live.

        Raises:
            UsageError: one is for live runs, or the scene is a rig file.
        """
        if self != LiveChoice():
            raise UsageError("--record is for live cameras: give --live and a rig file.")
        if scene.suffix == ".toml":
            raise UsageError(f"{scene} is a rig file of live cameras: give --live, too.")


def open_live(
    scene: Path,
    capture: CaptureOptions,
    live: LiveChoice,
    *,
    stream: Path,
    resume: bool,
    denoising: "DenoisingConfig",
) -> "LiveSource":
    """The cameras of a rig file; they are not opened yet.

    Raises:
        UsageError: an option that live cameras do not have.
    """
    from structgstream.data.live.source import LiveOptions, LiveSource

    if capture.start:
        raise UsageError("--start chooses from a recording; live cameras begin now.")
    if capture.every != 1:
        raise UsageError("--every chooses from a recording; of live cameras, fps in the rig file sets the rate.")
    if capture.frames is not None and capture.frames < 1:
        raise UsageError(f"--frames must be at least 1, got {capture.frames}.")
    options = LiveOptions(
        frames=capture.frames,
        held_out=capture.held_out,
        scale=capture.scale,
        near=capture.near,
        record=live.record,
        resume=resume,
        denoising=denoising,
    )
    with usage_errors():
        return LiveSource(scene, stream, options)


def run_metrics(source: "FrameStream", stream: Path, *, qualities: Sequence[str] = ()) -> "RunMetrics":
    """The metrics of a run that writes ``stream``, in several ``qualities`` if there are names of some."""
    from structgstream.data.live.source import LiveSource
    from structgstream.data.source import frame_count
    from structgstream.run_metrics import RunMetrics

    if isinstance(source, LiveSource):
        live, captured = source.status, source.captured
        return RunMetrics(stream, fps=source.fps, live=live, captured=captured, qualities=qualities)
    return RunMetrics(stream, fps=source.fps, total=frame_count(source), qualities=qualities)


def stop_of(source: "FrameStream") -> Callable[[], object]:
    """Ends a run that waits for live cameras; for a recording, does nothing."""
    from structgstream.data.live.source import LiveSource

    return source.stop if isinstance(source, LiveSource) else lambda: None


@contextmanager
def monitored(source: "FrameStream", metrics: "RunMetrics | None", *, done: int) -> Iterator[Display]:
    """Shows a run and writes its metrics; Ctrl-C ends a live one after the frame being fitted."""
    from structgstream.cli.dashboard import live_display
    from structgstream.data.live.source import LiveSource
    from structgstream.data.source import frame_count

    with ExitStack() as stack:
        if metrics is not None:
            stack.enter_context(metrics.running())
        if isinstance(source, LiveSource) and metrics is not None:
            stack.enter_context(source)
            stack.enter_context(stop_on_interrupt(source))
            yield stack.enter_context(live_display(metrics.values, frames=None, done=done))
        else:
            yield stack.enter_context(display(frame_count(source), done=done))


@contextmanager
def stop_on_interrupt(source: Stoppable) -> Iterator[None]:
    """The first Ctrl-C ends the stream after the frame being fitted, the second one at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupted(number: int, frame: FrameType | None) -> None:
        if source.stopped:
            raise KeyboardInterrupt
        source.stop()
        print("Ends after this frame; Ctrl-C again ends at once.", file=sys.stderr, flush=True)

    before = signal.signal(signal.SIGINT, interrupted)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
