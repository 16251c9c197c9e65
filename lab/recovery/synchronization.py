# SPDX-License-Identifier: Apache-2.0
"""What synchronisation by motion recovers of a synchronous capture whose cameras are shifted in time on purpose.

    python lab/recovery/synchronization.py CAPTURE
    python lab/recovery/synchronization.py CAPTURE --uncalibrated --keep 45 --cameras 1 2 3 4

Each line is one case: as filmed, each camera cut to ``--keep`` frames from a random one on, and half of the frames with
every other camera half a frame late. Errors are relative to the median of the cameras. The last lines are of the check.
"""

import argparse
import resource
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame
from structgstream.preparation.checking.times import check_synchronization, time_findings
from structgstream.preparation.footage import Footage
from structgstream.preparation.synchronization.synchronize import Synchronization, synchronize

LATE_FRAMES = (1, 3)  # of two cameras, for the check
MAX_FRAMES = 300


@dataclass(frozen=True)
class Shifted:
    """Some frames of a capture's cameras, as if each were a file that begins at 0: what synchronizing by motion asks of
    a ``Footage``.

    Args:
        rig: the cameras.
        images: all frames' pictures by camera.
        fps: of these frames.
        taken: by camera, numbers of the frames that its file holds.
    """

    rig: CameraRig
    images: Sequence[Mapping[str, NDArray[np.uint8]]]
    fps: float
    taken: Mapping[str, NDArray[np.intp]]

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.taken)

    @property
    def period(self) -> float:
        return float(np.diff(next(iter(self.taken.values()))[:2])[0]) / self.fps

    def stamps(self, name: str) -> NDArray[np.float64]:
        return (self.taken[name] - self.taken[name][0]) / self.fps

    def pictures(self, name: str, indices: NDArray[np.intp]) -> Iterator[NDArray[np.uint8]]:
        for index in indices:
            yield self.images[int(self.taken[name][index])][name]

    def audio(self, name: str) -> None:
        return None

    def size(self, name: str) -> tuple[int, int]:
        return self.rig[name].width, self.rig[name].height

    def metadata(self, name: str) -> dict[str, str]:
        return {}


@dataclass(frozen=True)
class LateSource:
    """A capture in which some cameras are late by whole frames."""

    rig: CameraRig
    images: Sequence[Mapping[str, NDArray[np.uint8]]]
    fps: float
    late: Mapping[str, int]
    name: str = "late"
    points: None = None

    def __len__(self) -> int:
        return len(self.images) - max(self.late.values())

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        for index in range(start, len(self)):
            shown = {name: self.images[index + self.late.get(name, 0)][name] for name in self.rig}
            yield MultiViewFrame(index, index / self.fps, shown)


def main(arguments: Sequence[str] | None = None) -> None:
    options = _options(arguments)
    source = bundled_clip() if options.capture is None else open_capture(options.capture)
    names = options.cameras or list(source.rig)
    images = [frame.images for _, frame in zip(range(MAX_FRAMES), source.frames(), strict=False)]
    for title, shifted in cases(source, images, names, keep=options.keep).items():
        _measure(title, shifted, calibrated=not options.uncalibrated)
    late = dict(zip((names[1], names[-1]), LATE_FRAMES, strict=True)) if len(names) > 2 else {}
    for checked in (source, LateSource(source.rig, images, source.fps, late)) if late else (source,):
        print(*[finding.sentence for finding in time_findings(check_synchronization(checked))] or ["synchronous"])
    print(f"peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def cases(
    source: FrameSource, images: Sequence[Mapping[str, NDArray[np.uint8]]], names: Sequence[str], *, keep: int | None
) -> dict[str, Shifted]:
    """The takes that are made of a capture, by what was done."""
    count, generator = len(images), np.random.default_rng(0)
    keep = keep or 3 * count // 4
    whole = Shifted(source.rig, images, source.fps, {name: np.arange(count) for name in names})
    first = {name: int(generator.integers(0, count - keep + 1)) for name in names}
    return {
        "as filmed": whole,
        f"cut to {keep} frames": replace(whole, taken={name: np.arange(keep) + first[name] for name in names}),
        "half of the frames": replace(
            whole, taken={name: np.arange(number % 2, count, 2) for number, name in enumerate(names)}
        ),
    }


def _measure(title: str, shifted: Shifted, *, calibrated: bool) -> None:
    cameras = {name: LensCamera(shifted.rig[name], Pinhole()) for name in shifted.cameras} if calibrated else None
    begun = time.process_time()
    try:
        found = synchronize(cast(Footage, shifted), method="motion", cameras=cameras)
    except CaptureError as error:
        print(f"{title:20} refused: {error}")
        return
    print(f"{title:20} {_told(found, shifted)}, {time.process_time() - begun:.1f} CPU s")


def _told(found: Synchronization, shifted: Shifted) -> str:
    truth = {name: taken[0] / shifted.fps for name, taken in shifted.taken.items()}
    errors = np.array([found.clocks[name].offset_seconds - truth[name] for name in truth])
    errors -= np.median(errors)
    sigmas = np.array([found.uncertainty_seconds[name] for name in truth])
    wrong = int((np.abs(errors) > shifted.period / 2).sum())
    return (
        f"{len(truth)} cameras, rms {1e3 * np.sqrt(np.mean(errors**2)):.1f} ms, largest "
        f"{1e3 * np.abs(errors).max():.1f} ms, sigma {1e3 * np.median(sigmas):.1f} ms, largest "
        f"{np.abs(errors / sigmas).max():.1f} sigma, {wrong} wrong by a frame"
    )


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?", help="a calibrated capture; the bundled clip without one")
    parser.add_argument("--uncalibrated", action="store_true", help="motion is compared without the calibration")
    parser.add_argument("--keep", type=int, help="frames that cameras are cut to; three quarters without it")
    parser.add_argument("--cameras", nargs="+", help="these cameras alone")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
