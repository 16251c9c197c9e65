# SPDX-License-Identifier: Apache-2.0
"""Memory use of the process: now, and its peak during each stage.

Note [Peaks]
~~~~~~~~~~~~
The system has one high-water mark of the resident size for the whole process. Linux lets a process reset it
(``/proc/self/clear_refs``, proc_pid_clear_refs(5)), so that the mark at the end of a stage (``VmHWM`` of
``/proc/self/status``) is the peak of that stage. Elsewhere the mark only rises, and a stage's value is the peak since
the process started. It covers all threads: a prefetched frame counts in the stage during which it is decoded. Other
readers of the mark, ``ru_maxrss`` included, see the reset value.
"""

import resource
from enum import StrEnum
from pathlib import Path

import torch

_CLEAR = Path("/proc/self/clear_refs")
_STATUS = Path("/proc/self/status")
_RESET_PEAK = "5"


class PeakKind(StrEnum):
    """What the values of a :class:`PeakMeter` mean."""

    STAGE = "stage"  # the stage's own peak
    PROCESS = "process"  # the process's peak up to the end of the stage
    NONE = "none"  # nothing was measured


class PeakMeter:
    """Measures the peak memory of consecutive stages (Note [Peaks]); the first starts on creation.

    Args:
        device: if it is a CUDA device, torch's allocations on it are measured too.

    Attributes:
        kind: meaning of ``process_bytes``.
        process_bytes: stage to largest resident size.
        device_bytes: stage to largest size of allocated tensors; empty without a CUDA device.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device if device.type == "cuda" else None
        self.process_bytes: dict[str, int] = {}
        self.device_bytes: dict[str, int] = {}
        self.kind = self._restart()

    def end(self, stage: str) -> None:
        """Records the peak of the stage that ends here and starts the next."""
        peak = status_bytes("VmHWM") if self.kind is PeakKind.STAGE else None
        if peak is None:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        self.process_bytes[stage] = peak
        if self._device is not None:
            self.device_bytes[stage] = torch.cuda.max_memory_allocated(self._device)
        restarted = self._restart()
        self.kind = self.kind if self.kind is restarted else PeakKind.PROCESS

    def _restart(self) -> PeakKind:
        if self._device is not None:
            torch.cuda.reset_peak_memory_stats(self._device)
        if status_bytes("VmHWM") is None:
            return PeakKind.PROCESS
        try:
            _CLEAR.write_text(_RESET_PEAK)
        except OSError:
            return PeakKind.PROCESS
        return PeakKind.STAGE


def resident_bytes() -> int | None:
    """Resident size of the process now; None where the system does not report it."""
    return status_bytes("VmRSS")


def status_bytes(name: str) -> int | None:
    """The size of this name in ``/proc/self/status``, in bytes; None if there is no such line."""
    try:
        lines = _STATUS.read_text().splitlines()
    except OSError:
        return None
    sizes = (line.split()[1] for line in lines if line.startswith(f"{name}:"))
    size = next(sizes, None)
    return None if size is None else int(size) * 1024
