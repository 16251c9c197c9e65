# SPDX-License-Identifier: Apache-2.0
"""Recordings that can be evaluated (one drawable per frame, of this method or another), and the captures of streams."""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from structgstream.cameras import Camera, CameraRig, rig_radius
from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.reader import StreamReader
from structgstream.data.images import ImageSource
from structgstream.data.open import open_capture
from structgstream.data.source import EveryNthFrame, FrameSource, Section, SourceWrapper, resized_to, section
from structgstream.data.video import VideoSource
from structgstream.errors import BackendError, CaptureError, ConfigError
from structgstream.evaluation.byte_count import shown_seconds
from structgstream.evaluation.report import FrameScores
from structgstream.scene.render import Drawable
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device

log = logging.getLogger(__name__)


class Recording(Protocol):
    """An opened file with one packet per frame, such as a ``StreamReader``.

    ``scenes`` decodes a drawable in normalised units frame by frame. ``complete`` states whether the run that wrote the
    file finished. The length of a drawable other than a ``Scene`` is its number of Gaussians. To be drawn on another
    device than the CPU, it needs a function ``on_device`` that returns its copy there.
    """

    @property
    def header(self) -> StreamHeader: ...

    @property
    def packets(self) -> Sequence[PacketInfo]: ...

    @property
    def header_bytes(self) -> int: ...

    @property
    def total_bytes(self) -> int: ...

    @property
    def complete(self) -> bool: ...

    def scenes(self, start: int = 0) -> Iterator[tuple[PacketInfo, Drawable]]: ...


def to_device(drawable: Drawable, device: torch.device) -> Drawable:
    """The drawable with its tensors on ``device``. Raises BackendError if it can only be drawn on the CPU."""
    if isinstance(drawable, Scene):
        return on_device(drawable, device)
    if device.type == "cpu":
        return drawable
    moved = getattr(drawable, "on_device", None)
    if moved is None:
        raise BackendError(f"A {type(drawable).__name__} cannot be drawn on {device}; choose --device cpu.")
    return moved(device)


def part_metadata(*, start: int, scale: float, every: int) -> dict[str, object]:
    """Metadata of a header on the part of a capture that a stream is made from, for :func:`capture_of`; ``scale`` is
    relative to the stored pictures, and a step of 1 is left out."""
    part: dict[str, object] = {"start": start, "scale": scale}
    return part if every == 1 else part | {"every": every}


def capture_of(header: StreamHeader, folder: Path | str, *, frames: int | None) -> FrameSource:
    """The part of a capture that a stream was made from, at the stream's sizes: the first of :func:`captures_of`."""
    return captures_of(header, folder, frames=frames)[0]


def captures_of(
    header: StreamHeader, folder: Path | str, *, frames: int | None
) -> tuple[FrameSource, FrameSource | None]:
    """The part of the capture in ``folder`` that a stream was made from, at the stream's sizes and at the stored size.

    The second is None if the stored pictures are not larger than the stream's.

    Args:
        frames: number of frames of the stream; None for all from the stream's first frame on.

    Raises:
        CaptureError: the folder contains no capture, or the capture ends before the stream's first frame.
    """
    whole = open_capture(folder, roving=False)  # they train frame 0, which the stream has
    cameras = {name: _as_in(header.rig, name, camera) for name, camera in whole.rig.cameras.items()}
    if all(cameras[name] is camera for name, camera in whole.rig.cameras.items()):
        return _part(whole, header, frames), None
    return _part(resized_to(whole, whole.rig.mapped(cameras)), header, frames), _part(whole, header, frames)


def _as_in(rig: CameraRig, name: str, camera: Camera) -> Camera:
    """The capture's ``camera`` at its size in the stream's ``rig``, which is never enlarged. The stream's own numbers
    are taken, because a scale that is found again from one rounded side may round the other differently."""
    ours = rig.cameras.get(name, camera)
    fits = ours.width <= camera.width and ours.height <= camera.height
    is_smaller = fits and (ours.width, ours.height) != (camera.width, camera.height)
    return camera.resized(ours.width, ours.height) if is_smaller else camera


def _part(source: FrameSource, header: StreamHeader, frames: int | None) -> FrameSource:
    start, every = int(header.metadata.get("start", 0)), int(header.metadata.get("every", 1))
    left = -(-(len(source) - start) // every)
    return section(source, start=start, frames=left if frames is None else min(frames, left), every=every)


def scored_cameras(header: StreamHeader, cameras: tuple[str, ...] | None) -> tuple[str, ...]:
    """The cameras to score: the named ones, or all that were held out. Raises ConfigError if a name is unknown, or no
    camera was held out and none is named."""
    if isinstance(cameras, str):
        raise ConfigError(f"cameras takes a list of names, as ({cameras!r},); got {cameras!r}.")
    if not cameras:
        if cameras is not None or not header.rig.testing:
            raise ConfigError(
                "The stream has no held-out camera to score; name cameras with --cameras (trained ones), "
                "or reconstruct with --held-out."
            )
        return header.rig.testing
    if unknown := [name for name in cameras if name not in header.rig.cameras]:
        raise ConfigError(f"The stream has no camera {unknown[0]!r}; it has {', '.join(header.rig)}.")
    return tuple(dict.fromkeys(cameras))


SAME_POSE = 1e-4
"""Largest difference of poses that count as equal: of rotation matrices, and of positions in radii of the rig, since
units are as small as millimetres of a desk, and coordinates as large as those of maps."""


def check_same_rig(header: StreamHeader, source: FrameSource, names: tuple[str, ...]) -> None:
    """Check that the capture's cameras of these names are equal to those of the stream. Raises CaptureError if one is
    missing, or has another calibration or picture size; a capture of another name is reported."""
    made = header.metadata.get("capture", source.name)
    if made != source.name:
        log.warning("The stream was made from the capture %r, and is compared with %r", made, source.name)
    for name in names:
        ours = header.rig[name]
        theirs = source.rig.cameras.get(name)
        if theirs is None:
            raise CaptureError(
                f"The capture {source.name} has no camera {name!r}, which the stream has; its cameras are "
                f"{', '.join(source.rig)}. Evaluate the stream on the capture it was made from."
            )
        if (theirs.width, theirs.height) != (ours.width, ours.height):
            raise CaptureError(
                f"Camera {name!r} has {theirs.width}x{theirs.height} pixels in the capture {source.name} and "
                f"{ours.width}x{ours.height} in the stream; evaluate the stream on the capture it was made from, "
                "opened at the same scale."
            )
        turned = (theirs.viewmat[:3, :3] - ours.viewmat[:3, :3]).abs().max()
        moved = (theirs.center - ours.center).norm() / rig_radius(header.rig)
        if max(turned, moved) > SAME_POSE or not torch.allclose(theirs.K, ours.K, atol=0.1):
            raise CaptureError(
                f"Camera {name!r} of the capture {source.name} has another calibration than in the stream; "
                "evaluate the stream on the capture it was made from."
            )


def check_has_first_frame(reader: StreamReader) -> None:
    """Check that frame 0 can be decoded, with which scores begin. Raises ConfigError."""
    if not reader.packets:
        lost = "frame 0 of the stream is lost or no longer stored, and scores begin with it"
        raise ConfigError(f"{lost if reader.runs else 'the stream has no whole frame'}, so there is nothing to score.")


def check_same_frames(recording: Recording, source: FrameSource) -> None:
    """Check that the capture has the frames of the recording. Raises CaptureError if it has fewer, they are of other
    times, or both state their start frame and step, and differ."""
    if len(source) < len(recording.packets):
        raise CaptureError(
            f"The stream has {len(recording.packets)} frames and this part of the capture {source.name} only "
            f"{len(source)}; evaluate it on the capture it was made from."
        )
    _check_numbers(recording.header, source)
    for info in recording.packets:
        if abs(info.pts_seconds - info.index / source.fps) > 0.5 / source.fps:
            raise CaptureError(
                f"Frame {info.index} of the stream is of {info.pts_seconds:.3f} s, and that of the capture "
                f"{source.name} of {info.index / source.fps:.3f} s (at {recording.header.fps:g} and {source.fps:g} "
                "frames a second), so they cannot be compared; a live run leaves frames out: reconstruct the capture, "
                "and evaluate that stream."
            )


def _check_numbers(header: StreamHeader, source: FrameSource) -> None:
    theirs, metadata = numbers_of(source), header.metadata
    if theirs is None or metadata.get("start") is None:
        return
    start, every = int(metadata["start"]), int(metadata.get("every", 1))
    if start != theirs.start:
        raise CaptureError(
            f"The stream begins at frame {start} of its capture and this part of the capture {source.name} at "
            f"frame {theirs.start}; open the capture with start={start}."
        )
    if every != theirs.step:
        raise CaptureError(
            f"The stream has 1 in {every} frames of its capture and this part of the capture {source.name} 1 in "
            f"{theirs.step}; open the capture with every={every}."
        )


def numbers_of(source: FrameSource) -> range | None:
    """Numbers of a source's frames in its whole capture; None if the type of source does not state them."""
    if not isinstance(source, SourceWrapper):
        return range(len(source)) if isinstance(source, ImageSource | VideoSource) else None
    inner = numbers_of(source.source)
    if inner is not None and isinstance(source, Section):
        return inner[source.first : source.first + source.length]
    return inner[:: source.step] if inner is not None and isinstance(source, EveryNthFrame) else inner


def stream_facts(reader: Recording, names: tuple[str, ...]) -> dict[str, Any]:
    """Sizes and rates of the file. Bytes are lengths of records in the file; megabits are 10^6 bits."""
    header, packets = reader.header, reader.packets
    seconds = shown_seconds(packets, header.fps)
    packet_bytes = sum(info.bytes for info in packets)
    fields = Counter[str]()
    for info in packets:
        fields.update(info.field_bytes)
    return {
        "frames": len(packets),
        "key_frames": sum(info.kind == PacketKind.KEY for info in packets),
        "fps": header.fps,
        "codec": header.codec,
        "complete": reader.complete,
        "cameras": {name: "held out" if name in header.rig.held_out else "training" for name in names},
        "training_cameras": len(header.rig.training),
        "header_bytes": reader.header_bytes,
        "packet_bytes": packet_bytes,
        "total_bytes": reader.total_bytes,
        "field_bytes": dict(fields),
        "megabits_per_second": packet_bytes * 8e-6 / seconds,
        "megabits_per_second_with_header": reader.total_bytes * 8e-6 / seconds,
        "metadata": dict(header.metadata),
        "config": dict(header.config),
    }


def training_facts(logs: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Seconds and peak memory of the training run, from its log; empty without one."""
    logs = [log for log in logs if log]
    if not logs:
        return {}
    online = [log["total_seconds"] for log in logs if log["index"] > 0]
    largest: dict[str, int] = {}  # of frame 0 and of later frames, by stage
    for log in logs:
        part = "online" if log["index"] else "first frame"
        for stage, size in log.get("peak_memory_bytes_by_stage", {}).items():
            largest[f"{part}, {stage}"] = max(size, largest.get(f"{part}, {stage}", 0))
    return {
        "seconds_first": next((log["total_seconds"] for log in logs if log["index"] == 0), None),
        "seconds_online_mean": float(np.mean(online)) if online else None,
        "peak_memory_bytes": max(log["peak_memory_bytes"] or 0 for log in logs) or None,
        "peak_memory_bytes_by_stage": largest,
    }


def comparison_facts(
    frames: Sequence[FrameScores], names: Sequence[str], left_out: Mapping[str, Sequence[float]]
) -> dict[str, Any]:
    """Data that was not compared, by camera: frames without a picture, and the mean of ``left_out``, the shares of
    masked pixels of its pictures.

    Cameras without such data are left out.
    """
    absent = {name: sum(name not in frame.cameras for frame in frames) for name in names}
    masked = {name: float(np.mean(shares)) for name, shares in left_out.items()}
    return {
        "absent_frames": {name: count for name, count in absent.items() if count},
        "masked_share": {name: share for name, share in masked.items() if share > 0.0},
    }
