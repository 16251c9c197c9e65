# SPDX-License-Identifier: Apache-2.0
"""The pictures of an experiment, and a fingerprint by which two experiments' pictures are compared."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from structgstream.data.source import FrameSource


@dataclass(frozen=True)
class CapturePart:
    """A part of a capture, as ``data.open.open_capture`` takes it.

    Args:
        folder: the capture.
        held_out: cameras to keep from training; None for the capture's own.
        scale: size of the pictures relative to the stored ones.
        start: first frame.
        frames: number of frames; None for all.
        near: distance of the near plane, in the capture's units; None for the capture's own.
        every: step between frames, for methods that fit each frame alone, which stand for all frames.
        thinned: step between the frames that are taken as filmed: a recording at so much a lower rate.
        scored: the held-out cameras to score; None for all. Choices and reports use different ones.
    """

    folder: Path
    held_out: tuple[str, ...] | None = None
    scale: float = 1.0
    start: int = 0
    frames: int | None = None
    near: float | None = None
    every: int = 1
    scored: tuple[str, ...] | None = None
    thinned: int = 1

    def open(self) -> "FrameSource":
        """The frames.

        Raises:
            CaptureError: the folder holds no capture, or not these frames or cameras.
        """
        from structgstream.data.open import open_capture
        from structgstream.data.source import every_nth_frame

        whole = open_capture(
            self.folder,
            held_out=self.held_out,
            scale=self.scale,
            start=self.start,
            frames=self.frames,
            near=self.near,
            every=self.thinned,
        )
        return every_nth_frame(whole, self.every, rate=whole.fps)


def capture_facts(part: CapturePart, source: "FrameSource") -> dict[str, Any]:
    """Facts of a capture for results, as plain values; equal facts mean the same pictures and cameras."""
    sizes = sorted({(source.rig[name].width, source.rig[name].height) for name in source.rig})
    facts = {
        "name": source.name,
        "fingerprint": fingerprint(source),
        "frames": len(source),
        "start": part.start,
        "every": part.every,
        "scale": part.scale,
        "near": part.near,
        "fps": source.fps,
        "sizes": [list(size) for size in sizes],
        "training_cameras": len(source.rig.training),
        "held_out": list(source.rig.testing),
        "scored": list(source.rig.testing if part.scored is None else part.scored),
    }
    return facts if part.thinned == 1 else facts | {"thinned": part.thinned}


def fingerprint(source: "FrameSource") -> str:
    """SHA-256 over the calibration, the split, and every camera's pictures of the first and the last frame."""
    digest = hashlib.sha256()
    for name in source.rig:
        camera = source.rig[name]
        split = "held out" if name in source.rig.held_out else "training"
        digest.update(f"{name} {split} {camera.width} {camera.height} {camera.near!r}\n".encode())
        digest.update(camera.viewmat.numpy().tobytes() + camera.K.numpy().tobytes())
    for index in sorted({0, len(source) - 1}):
        frame = next(source.frames(index))
        for name, image in frame.images.items():
            digest.update(image.tobytes())
            if name in frame.masks:
                digest.update(frame.masks[name].tobytes())
    return digest.hexdigest()
