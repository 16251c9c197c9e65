# SPDX-License-Identifier: Apache-2.0
"""Facts of a recording, its capture and its log, without rendering."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.data.images import ImageSource
from structgstream.data.source import FrameSource
from structgstream.data.video import VideoSource
from structgstream.data.wrappers import EveryNthFrame, Section, SourceWrapper
from structgstream.errors import CaptureError, ConfigError
from structgstream.evaluation.recording import Recording
from structgstream.evaluation.report import FrameScores


def scored_cameras(header: StreamHeader, cameras: tuple[str, ...] | None) -> tuple[str, ...]:
    """The cameras to score: the named ones, or all that were held out.

    Raises:
        ConfigError: a name is unknown, or no camera was held out and none is named.
    """
    if cameras is None:
        if not header.rig.testing:
            raise ConfigError(
                "The stream has no held-out camera to score; name cameras with --cameras (trained ones), "
                "or reconstruct with --held-out."
            )
        return header.rig.testing
    if unknown := [name for name in cameras if name not in header.rig.cameras]:
        raise ConfigError(f"The stream has no camera {unknown[0]!r}; it has {', '.join(header.rig)}.")
    return cameras


def check_same_rig(header: StreamHeader, source: FrameSource, names: tuple[str, ...]) -> None:
    """Check that the capture's cameras of these names are equal to those of the stream.

    Raises:
        CaptureError: one is missing, or has another calibration or picture size.
    """
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
                f"{ours.width}x{ours.height} in the stream; give the --scale of the reconstruction."
            )
        if not (torch.allclose(theirs.viewmat, ours.viewmat, atol=1e-4) and torch.allclose(theirs.K, ours.K, atol=0.1)):
            raise CaptureError(
                f"Camera {name!r} of the capture {source.name} has another calibration than in the stream; "
                "evaluate the stream on the capture it was made from."
            )


def check_same_frames(recording: Recording, source: FrameSource) -> None:
    """Check that the capture has the frames of the recording.

    Raises:
        CaptureError: it has fewer, or both state their start frame and step, and differ.
    """
    if len(source) < len(recording.packets):
        raise CaptureError(
            f"The stream has {len(recording.packets)} frames and this part of the capture {source.name} only "
            f"{len(source)}; evaluate it on the capture it was made from."
        )
    theirs, metadata = numbers_of(source), recording.header.metadata
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
    seconds = len(packets) / header.fps
    packet_bytes = sum(info.bytes for info in packets)
    fields: dict[str, int] = {}
    for info in packets:
        for name, size in info.field_bytes.items():
            fields[name] = fields.get(name, 0) + size
    keys = [info for info in packets if info.kind == PacketKind.KEY]
    return {
        "frames": len(packets),
        "key_frames": len(keys),
        "fps": header.fps,
        "codec": header.codec,
        "complete": reader.complete,
        "cameras": {name: "held out" if name in header.rig.held_out else "training" for name in names},
        "training_cameras": len(header.rig.training),
        "header_bytes": reader.header_bytes,
        "packet_bytes": packet_bytes,
        "total_bytes": reader.total_bytes,
        "field_bytes": fields,
        "megabits_per_second": packet_bytes * 8e-6 / seconds,
        "megabits_per_second_with_header": reader.total_bytes * 8e-6 / seconds,
        "metadata": dict(header.metadata),
    }


def training_facts(logs: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Seconds and peak memory of the training run, from its log; empty without one."""
    logs = [log for log in logs if log]
    if not logs:
        return {}
    online = [log["total_seconds"] for log in logs if log["index"] > 0]
    return {
        "seconds_first": next((log["total_seconds"] for log in logs if log["index"] == 0), None),
        "seconds_online_mean": float(np.mean(online)) if online else None,
        "peak_memory_bytes": max(log["peak_memory_bytes"] or 0 for log in logs) or None,
        "peak_memory_bytes_by_stage": _largest_by_stage(logs),
    }


def _largest_by_stage(logs: list[Mapping[str, Any]]) -> dict[str, int]:
    """The largest peak of each stage, separately for frame 0 and for later frames."""
    largest: dict[str, int] = {}
    for log in logs:
        part = "online" if log["index"] else "first frame"
        for stage, size in log.get("peak_memory_bytes_by_stage", {}).items():
            largest[f"{part}, {stage}"] = max(size, largest.get(f"{part}, {stage}", 0))
    return largest


def comparison_facts(
    frames: Sequence[FrameScores], names: Sequence[str], left_out: Mapping[str, Sequence[float]]
) -> dict[str, Any]:
    """Data that was not compared: frames without a picture and mean shares of masked pixels, both by camera.

    Cameras without such data are left out.

    Args:
        left_out: share of masked pixels in each of a camera's pictures, by camera name.
    """
    absent = {name: sum(name not in frame.cameras for frame in frames) for name in names}
    masked = {name: float(np.mean(shares)) for name, shares in left_out.items()}
    return {
        "absent_frames": {name: count for name, count in absent.items() if count},
        "masked_share": {name: share for name, share in masked.items() if share > 0.0},
    }
