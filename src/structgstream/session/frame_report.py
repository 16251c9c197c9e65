# SPDX-License-Identifier: Apache-2.0
"""The report of one frame, and the meter of its seconds and memory."""

import time
from collections.abc import Iterator, Mapping, Sized
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch

from structgstream.codec.packets import PacketKind
from structgstream.codec.scene_coder import Encoded
from structgstream.memory import PeakKind, PeakMeter
from structgstream.scene.render import Drawable
from structgstream.scene.scene import Scene
from structgstream.training.result import FitResult

T = TypeVar("T")
StateT = TypeVar("StateT", bound=Drawable)


@dataclass(frozen=True)
class FrameReport:
    """The report of one frame.

    ``spawned`` and ``pruned`` count free Gaussians, ``grown`` and ``removed`` anchors, ``iterations`` the optimisation
    steps. ``field_bytes`` are the packet's bytes by field.

    Peaks of memory are by stage: ``read``, ``fit``, ``store`` (encoding and writing), and ``prepare`` (computing frame
    0's data for later frames). ``peak_memory_kind`` states whether they are per stage (Note [Peaks]);
    ``peak_device_bytes`` are the GPU's, if any. ``cpu_seconds`` is the CPU time of all threads of the process.
    ``losses`` are the means of the loss terms, without their weights, over the fit's last pass through the cameras.
    ``absent`` are the cameras without a picture of this frame, including held-out ones. ``begins`` states why the frame
    begins another period, and is None if it does not. ``mean_of`` is the average number of pictures whose mean is a
    training pixel (``data/denoising.py``).
    """

    index: int
    pts_seconds: float
    kind: PacketKind
    bytes: int
    field_bytes: Mapping[str, int]
    train_psnr: float
    anchors: int
    moving: int
    free: int
    spawned: int
    pruned: int
    grown: int = 0
    removed: int = 0
    iterations: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    peak_memory_bytes: Mapping[str, int] = field(default_factory=dict)
    peak_device_bytes: Mapping[str, int] = field(default_factory=dict)
    peak_memory_kind: PeakKind = PeakKind.NONE
    cpu_seconds: float = 0.0
    counts: Mapping[str, int] = field(default_factory=dict)
    losses: Mapping[str, float] = field(default_factory=dict)
    absent: tuple[str, ...] = ()
    begins: str | None = None
    mean_of: float = 1.0


class FrameMeter:
    """Measures seconds and memory of one frame's consecutive stages; the first starts on creation."""

    def __init__(self, device: torch.device) -> None:
        self._peaks = PeakMeter(device)
        self._started = self._last = time.perf_counter()
        self._cpu_started = time.process_time()
        self._seconds: dict[str, float] = {}

    def end(self, stage: str, *, peak: str | None = None) -> None:
        """Ends a stage of time, and the stage ``peak`` of memory if it is given."""
        if peak is not None:
            self._peaks.end(peak)
        now = time.perf_counter()
        self._seconds[stage], self._last = now - self._last, now

    def report(
        self,
        fit: FitResult[StateT],
        encoded: Encoded[StateT],
        size: int,
        *,
        remarks: Mapping[str, Any] | None = None,
    ) -> FrameReport:
        """The report of a frame with a packet of ``size`` bytes, including the remarks of its task."""
        packet, state = encoded.packet, encoded.reconstruction
        fitted = {name: value for name, value in vars(fit).items() if name not in ("scene", "seconds")}
        read = {name: seconds for name, seconds in self._seconds.items() if name == "read"}
        return FrameReport(
            index=packet.index,
            pts_seconds=packet.pts_seconds,
            kind=packet.kind,
            bytes=size,
            field_bytes=packet.field_bytes,
            **counts(state),
            **fitted,
            seconds={**read, **fit.seconds, **self._seconds, "total": self._last - self._started},
            peak_memory_bytes=self._peaks.process_bytes,
            peak_device_bytes=self._peaks.device_bytes,
            peak_memory_kind=self._peaks.kind,
            cpu_seconds=time.process_time() - self._cpu_started,
            **(remarks or {}),
        )


def metered(items: Iterator[T], device: torch.device) -> Iterator[tuple[FrameMeter, T]]:
    """Each item with the meter of its frame, whose stage ``read`` is the time until the item was available."""
    meter = FrameMeter(device)
    for item in items:
        meter.end("read", peak="read")
        yield meter, item
        meter = FrameMeter(device)


def counts(state: Drawable) -> dict[str, int]:
    """Numbers of ``anchors`` and ``free`` Gaussians; without anchors all Gaussians count as free."""
    if isinstance(state, Scene):
        return {"anchors": len(state.anchors), "free": len(state.free)}
    return {"anchors": 0, "free": len(state) if isinstance(state, Sized) else 0}
