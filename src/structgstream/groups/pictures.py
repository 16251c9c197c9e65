# SPDX-License-Identifier: Apache-2.0
"""Opens the capture of a group as the shared header describes it, and computes its fingerprint."""

import hashlib
from pathlib import Path

import numpy as np

from structgstream.cameras import CameraRig
from structgstream.codec.packets import StreamHeader
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import WithRig, section
from structgstream.errors import CaptureError
from structgstream.evaluation.recording import capture_of


def open_for(header: StreamHeader, folder: Path, *, frames: int | None) -> FrameSource:
    """The first ``frames`` frames of the capture that the stream of ``header`` was made from, with its rig.

    Picture size, first frame, held-out cameras and near planes are those of the header; frames count from its first.

    Raises:
        CaptureError: the capture has other cameras or fewer frames.
    """
    source = capture_of(header, folder, frames=None)
    if frames is not None and frames > len(source):
        raise CaptureError(f"The capture {source.name} has {len(source)} frames, but {frames} are needed.")
    source = section(source, frames=frames)
    if differing := _differing(source.rig, header.rig):
        raise CaptureError(
            f"The capture {source.name} is not the one of the header: {', '.join(differing[:5])} "
            f"{'differs' if len(differing) == 1 else 'differ'} in pose, lens or size. Give the capture that the header "
            "was made from."
        )
    return WithRig(source, header.rig)


def _differing(found: CameraRig, expected: CameraRig) -> list[str]:
    """Names of the cameras that differ between the rigs."""

    def same(name: str) -> bool:
        if name not in found.cameras or name not in expected.cameras:
            return False
        one, other = found[name], expected[name]
        sizes = (one.width, one.height) == (other.width, other.height)
        return sizes and bool((one.viewmat == other.viewmat).all()) and bool((one.K == other.K).all())

    return [name for name in dict.fromkeys([*expected, *found]) if not same(name)]


def fingerprint(source: FrameSource) -> str:
    """SHA-256 over the calibration, the split, the frame rate, and every camera's picture of frame 0."""
    digest = hashlib.sha256(f"{source.fps!r}\n".encode())
    for name in source.rig:
        camera = source.rig[name]
        split = "held out" if name in source.rig.held_out else "training"
        digest.update(f"{name} {split} {camera.width} {camera.height} {camera.near!r}\n".encode())
        digest.update(camera.viewmat.numpy().tobytes() + camera.K.numpy().tobytes())
    frame = next(source.frames(0))
    for name in source.rig:
        if name in frame.images:
            digest.update(name.encode() + np.ascontiguousarray(frame.images[name]).tobytes())
        if name in frame.masks:
            digest.update(np.packbits(frame.masks[name]).tobytes())
    return digest.hexdigest()
