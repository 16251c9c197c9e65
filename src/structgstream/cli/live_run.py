# SPDX-License-Identifier: Apache-2.0
"""``reconstruct --live``: its options, opening the cameras, the display, and the end of a run."""

import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from structgstream.cli.app import StopSignal, UsageError, usage_errors
from structgstream.cli.options import CaptureOptions, Flag, shown_as
from structgstream.cli.progress import Bars, Lines, display, human_bytes, plain_table, summary

if TYPE_CHECKING:
    from structgstream.data.denoising import DenoisingConfig
    from structgstream.data.live.source import LiveSource
    from structgstream.data.source import FrameStream
    from structgstream.recorder import RunMetrics
    from structgstream.session.frame_report import FrameReport
    from structgstream.training.result import Step


@dataclass(frozen=True)
class LiveChoice:
    """Options of live cameras."""

    live: Flag = False
    """FOLDER is a rig file of cameras that send now; what they send while a frame is fitted is skipped. The stream ends
    after --frames, or with Ctrl-C."""
    record: Annotated[Path | None, shown_as("FOLDER")] = None
    """Live only: record all that the cameras send, as a capture that can be reconstructed with every frame."""

    def check(self, scene: Path) -> None:
        """Check the options of a run that is not live."""
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
    sound: str | None = None,
) -> "LiveSource":
    """The cameras of a rig file; they are not opened yet."""
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
        sound=None if sound == "none" else sound,
    )
    with usage_errors():
        return LiveSource(scene, stream, options)


def run_metrics(source: "FrameStream", stream: Path, *, qualities: Sequence[str] = ()) -> "RunMetrics":
    """The metrics of a run that writes ``stream``, in several ``qualities`` if there are names of some."""
    from structgstream.data.live.source import LiveSource
    from structgstream.data.source import frame_count
    from structgstream.recorder import RunMetrics

    if not isinstance(source, LiveSource):
        return RunMetrics(stream, fps=source.fps, total=frame_count(source), qualities=qualities)
    return RunMetrics(stream, fps=source.fps, live=source.status, captured=source.captured, qualities=qualities)


@contextmanager
def monitored(source: "FrameStream", metrics: "RunMetrics | None", *, done: int) -> "Iterator[Display]":
    """Shows a run and writes its metrics; Ctrl-C ends a live one after the frame being fitted."""
    from structgstream.data.live.source import LiveSource
    from structgstream.data.source import frame_count

    with ExitStack() as stack:
        if metrics is not None:
            stack.enter_context(metrics.running())
        if isinstance(source, LiveSource) and metrics is not None:
            stack.enter_context(source)
            stack.enter_context(StopSignal(source.stop, number=signal.SIGINT))
            yield stack.enter_context(live_display(metrics.values, done=done))
        else:
            yield stack.enter_context(display(frame_count(source), done=done))


REFRESH = 4  # a second
GAP = "  "
Values = Callable[[], Mapping[str, Any]]


def live_display(values: Values, *, done: int = 0, console: Console | None = None) -> "Dashboard | Lines":
    """A dashboard when ``console`` (default: standard output) is a terminal, else a line a frame."""
    console = Console() if console is None else console
    if console.is_terminal:
        return Dashboard(values, done, console=console)
    return Lines(None, done, console=console, further=lambda: GAP + GAP.join(state_parts(values())))


class Dashboard:
    """Cameras, queues, stages and the last frame, drawn again a few times a second."""

    def __init__(self, values: Values, done: int = 0, *, console: Console) -> None:
        self._values, self._console = values, console
        self._step = self._last = ""
        self._next, self._ended = done + 1, False  # counted from 1, as the lines of frames are
        self._live = Live(
            console=console, refresh_per_second=REFRESH, get_renderable=self._drawn, vertical_overflow="crop"
        )

    def __enter__(self) -> "Dashboard":
        self._live.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._ended = True
        self._live.stop()

    def step(self, step: "Step") -> None:
        """Notes the iteration."""
        self._step = f"frame {self._next}  iteration {step.iteration}/{step.iterations}  loss {step.loss:.4f}"

    def frame(self, report: "FrameReport", *, quality: str | None = None) -> None:
        """Notes the frame."""
        self._step, self._last = "", summary(report, None, quality=quality)
        self._next = report.index + 2

    def _drawn(self) -> Panel:
        values = self._values()
        # What is cut off on a terminal of few lines is the end: cameras, of which the first line counts those present.
        parts: list[RenderableType] = [Flow(state_parts(values))]
        parts += [Flow(stages, style="dim")] if (stages := stage_parts(values)) else []
        parts += [Text()]
        parts += [Flow(self._last.split("  "))] if self._last else []
        doing = self._step or ("" if self._ended else self._between(values))
        parts += [Text(doing, style="dim")] if doing else []
        if values.get("qualities"):
            parts += [Text(), qualities_table(values["qualities"])]
        if values.get("live") is not None:
            parts += [Text(), cameras_table(values["live"]["cameras"])]
        title = f"{values['stream']}  {values['state']}  {_duration(values['running_seconds'])}"
        # A terminal shows Ctrl-C as ^C, which must not begin another line: the panel would be drawn one line too low.
        width = max(self._console.width - len("^C"), 1)
        return Panel(Group(*parts), title=title, title_align="left", width=width)

    def _between(self, values: Mapping[str, Any]) -> str:
        """What is done between two iterations, which may be most of a frame's time."""
        live = values.get("live")
        if live is not None and not any(camera["present"] for camera in live["cameras"].values()):
            return "waits for cameras"
        return f"frame {self._next}  takes pictures and prepares them"


Display = Bars | Lines | Dashboard
"""Displays the progress of a reconstruction: ``step`` after each iteration, ``frame`` after a frame is stored."""


class Flow:
    """Short texts one after the other, as many in a line as fit; none is broken that fits into one."""

    def __init__(self, texts: Iterable[str], *, style: str = "") -> None:
        self._texts, self._style = [text.strip() for text in texts if text.strip()], style

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        lines: list[str] = []
        for text in self._texts:
            longer = f"{lines[-1]}{GAP}{text}" if lines else ""
            if longer and cell_len(longer) <= options.max_width:
                lines[-1] = longer
            else:
                lines.append(text)
        yield Text("\n".join(lines), style=self._style)


def state_parts(values: Mapping[str, Any]) -> list[str]:
    """Rates, queues, room and delay."""
    live = values.get("live")
    parts = []
    if live is not None:
        present = sum(camera["present"] for camera in live["cameras"].values())
        parts = [
            f"{present}/{len(live['cameras'])} cameras",
            f"in {_number(values['frames_in_per_second'])}/s out {_number(values['frames_out_per_second'], 2)}/s",
            f"skipped {live['skipped_sets']:,}",
        ]
        if live["delay_seconds"] is not None:
            parts.append(f"pictures {live['delay_seconds']:.2f} s old")
    if values["bits_per_second"] is not None:
        parts.append(f"{values['bits_per_second'] / 1e3:,.1f} kbit/s")
    if values["disk_free_bytes"] is not None:
        parts.append(f"disk {human_bytes(values['disk_free_bytes'])} free")
    if values["resident_bytes"] is not None:
        parts.append(f"memory {human_bytes(values['resident_bytes'])}")
    return parts


def stage_parts(values: Mapping[str, Any]) -> list[str]:
    """Seconds by stage of the last frames' mean, the longest first."""
    stages = sorted(values["seconds_by_stage"].items(), key=lambda item: -item[1])
    return [f"{name} {seconds:.2f} s" for name, seconds in stages if name != "total"][:8]


def qualities_table(qualities: Mapping[str, Mapping[str, Any]]) -> Table:
    """A row a quality: its frames, its rate and bytes, decibels on training views, and seconds a frame."""
    numbers = ("frames", "kbit/s", "bytes", "train dB", "s a frame")
    table = plain_table("quality", *numbers, right=numbers)
    for name, own in qualities.items():
        bits = own["bits_per_second"]
        table.add_row(
            Text(name),
            "-" if own["frames"] is None else f"{own['frames']:,}",
            "-" if bits is None else f"{bits / 1e3:,.1f}",
            human_bytes(own["bytes"]),
            _number(own["train_psnr"], 2),
            _number(own["seconds_by_stage"].get("total"), 2),
        )
    return table


def cameras_table(cameras: Mapping[str, Mapping[str, Any]]) -> Table:
    """A row a camera: whether it sends, its pictures, and what went wrong how often."""
    table = plain_table("camera", "", "pictures", "queue", "faults", right=("pictures", "queue"))
    for name, camera in cameras.items():
        faults = Flow(f"{kind} {count:,}" for kind, count in camera["faults"].items())
        state = Text("sends", style="green") if camera["present"] else Text("absent", style="red")
        table.add_row(Text(name), state, f"{camera['decoded']:,}", str(camera["queued"]), faults)
    return table


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _duration(seconds: float) -> str:
    days = f" + {int(seconds // 86400)} d" if seconds >= 86400 else ""
    return time.strftime("%H:%M:%S", time.gmtime(seconds % 86400)) + days
