# SPDX-License-Identifier: Apache-2.0
"""Scores a stream from its file alone: decode, render what held-out cameras saw, compare."""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import of_cameras
from structgstream.errors import CaptureError, ConfigError
from structgstream.evaluation.affine import psnr_affine
from structgstream.evaluation.environment import environment
from structgstream.evaluation.masks import changed_pixels
from structgstream.evaluation.metrics import decibels, mean_of_squares, quantised, squared_errors, ssim
from structgstream.evaluation.report import FrameScores, Report, Scores, course, mean_scores
from structgstream.kernels.backend import Backend
from structgstream.memory import PeakMeter
from structgstream.scene.render import render
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device

if TYPE_CHECKING:
    from structgstream.codec.reader import PacketInfo, StreamReader

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Compared:
    """One camera of one frame: what it took, what the stream renders, and the scores."""

    camera: str
    truth: Picture
    picture: Picture
    scores: Scores


EVALUATION = "evaluation"
"""Name of the stage of memory that scoring is."""

Observer = Callable[[int, Compared], None]


def evaluate(
    reader: "StreamReader",
    source: FrameSource,
    *,
    backend: Backend,
    cameras: tuple[str, ...] | None = None,
    log: Mapping[int, Mapping[str, Any]] | None = None,
    observer: Observer | None = None,
) -> Report:
    """Every score of every frame that the file holds and the capture shows.

    Args:
        reader: the opened file.
        source: the capture, cut and scaled as it was for the reconstruction.
        backend: what renders.
        cameras: names of the cameras to score; None for those that training did not see.
        log: the trainer's log by frame number (``run_log.read_log``).
        observer: called with frame number and comparison for every picture, for pictures and progress.

    Raises:
        CaptureError: the capture is not the one of the stream: a camera is missing, stands elsewhere, or has
            pictures
            of another size; or it has fewer frames.
        ConfigError: there is no camera to score.
        StreamError: a packet is damaged.
    """
    names = scored_cameras(reader.header, cameras)
    check_same_rig(reader.header, source, names)
    if len(source) < len(reader.packets):
        raise CaptureError(
            f"The stream has {len(reader.packets)} frames and this part of the capture {source.name} only "
            f"{len(source)}; evaluate it on the capture it was made from."
        )
    views = {name: reader.header.similarity.camera(reader.header.rig[name]) for name in names}
    first: dict[str, Picture] = {}
    frames = []
    peaks = PeakMeter(backend.device)
    for frame, (info, scene) in zip(of_cameras(source, names).frames(), reader.scenes(0)):
        compared = []
        placed = on_device(scene, backend.device)
        for name in names:
            truth = frame.images[name]
            first.setdefault(name, truth)
            picture, seconds = rendered(placed, views[name], backend)
            compared.append(
                Compared(name, truth, picture, score(picture, truth, first[name], backend=backend, seconds=seconds))
            )
            if observer is not None:
                observer(info.index, compared[-1])
        frames.append(_frame_scores(info, scene, compared, dict((log or {}).get(info.index, {}))))
    by_camera = {name: mean_scores(frame.cameras[name] for frame in frames) for name in names}
    mean = mean_scores(scores for frame in frames for scores in frame.cameras.values())
    facts = stream_facts(reader, names) | course([frame.mean.psnr for frame in frames]) | _training_facts(frames)
    peaks.end(EVALUATION)
    machine = environment() | {"backend": backend.name} | _evaluation_memory(peaks)
    return Report(frames, by_camera, mean, facts, machine)


def score(picture: Picture, truth: Picture, first: Picture, *, backend: Backend, seconds: float = 0.0) -> Scores:
    """The scores of a rendering against ``truth``; ``first`` is the camera's picture of frame 0."""
    errors, changed = squared_errors(picture, truth), changed_pixels(truth, first)
    total, moving = int(errors.sum(dtype=np.int64)), int(np.count_nonzero(changed))
    in_changed = int(np.sum(errors, where=changed, dtype=np.int64))
    return Scores(
        psnr=decibels(mean_of_squares(total, errors.size)),
        ssim=ssim(picture, truth, backend),
        psnr_affine=psnr_affine(picture, truth),
        psnr_changed=decibels(mean_of_squares(in_changed, moving)) if moving else None,
        psnr_still=decibels(mean_of_squares(total - in_changed, errors.size - moving))
        if moving < errors.size
        else None,
        changed_share=moving / errors.size,
        render_seconds=seconds,
    )


def rendered(scene: Scene, camera: Camera, backend: Backend) -> tuple[Picture, float]:
    """The 8-bit picture of ``camera`` (scene units), and the seconds it took until it was in main memory."""
    began = time.perf_counter()
    picture = quantised(render(scene, camera, backend).image)
    return picture, time.perf_counter() - began


def scored_cameras(header: StreamHeader, cameras: tuple[str, ...] | None) -> tuple[str, ...]:
    """The cameras to score: the named ones, or all that were held out.

    Raises:
        ConfigError: an unknown name, or nothing was held out and nothing named.
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
    """The capture's cameras of these names are those of the stream.

    Raises:
        CaptureError: one is missing, stands elsewhere, or has pictures of another size.
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


def stream_facts(reader: "StreamReader", names: tuple[str, ...]) -> dict[str, Any]:
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


def compared_frames(
    reader: "StreamReader", source: FrameSource, *, backend: Backend, camera: str
) -> Iterator[tuple[Picture, Picture]]:
    """Truth and rendering of one camera, frame by frame.

    Raises:
        CaptureError: see :func:`evaluate`.
    """
    check_same_rig(reader.header, source, (camera,))
    view = reader.header.similarity.camera(reader.header.rig[camera])
    for frame, (_, scene) in zip(of_cameras(source, (camera,)).frames(), reader.scenes(0)):
        yield frame.images[camera], rendered(on_device(scene, backend.device), view, backend)[0]


def _frame_scores(info: "PacketInfo", scene: Scene, compared: list[Compared], log: dict[str, Any]) -> FrameScores:
    scores = {entry.camera: entry.scores for entry in compared}
    return FrameScores(
        index=info.index,
        pts_seconds=info.pts_seconds,
        kind=PacketKind(info.kind).name.lower(),
        bytes=info.bytes,
        field_bytes={name: size for name, size in info.field_bytes.items()},  # noqa: C416 -- widens the key type
        anchors=len(scene.anchors),
        free=len(scene.free),
        cameras=scores,
        mean=mean_scores(scores.values()),
        log=log,
    )


def _training_facts(frames: list[FrameScores]) -> dict[str, Any]:
    logs = [frame.log for frame in frames if frame.log]
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
    """The largest peak of each stage, frame 0 apart from the others, which have other work."""
    largest: dict[str, int] = {}
    for log in logs:
        part = "online" if log["index"] else "first frame"
        for stage, size in log.get("peak_memory_bytes_by_stage", {}).items():
            largest[f"{part}, {stage}"] = max(size, largest.get(f"{part}, {stage}", 0))
    return largest


def _evaluation_memory(peaks: PeakMeter) -> dict[str, Any]:
    return {
        "peak_memory_bytes": peaks.process_bytes.get(EVALUATION),
        "peak_device_bytes": peaks.device_bytes.get(EVALUATION),
        "peak_memory_kind": str(peaks.kind),
    }
