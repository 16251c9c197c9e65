# SPDX-License-Identifier: Apache-2.0
"""The result of an evaluation, and its JSON, whose keys ``docs/evaluation.md`` lists."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.atomic_files import atomic_write


@dataclass(frozen=True)
class Scores:
    """Scores of one picture, or their mean over several, as ``docs/evaluation.md`` defines them.

    Those without pixels, without a fit of the camera's colour (``psnr_camera_color``), not requested or not available
    are None; ``stream["not_available"]`` has the reason of the last. ``e_warp``, ``temporal_flip``, ``t_lpips``,
    ``flicker`` and ``truth_flicker`` compare consecutive frames, so they are None in frame 0.
    """

    psnr: float
    ssim: float
    psnr_affine: float
    psnr_changed: float | None
    psnr_still: float | None
    changed_share: float
    render_seconds: float
    ms_ssim: float | None = None
    flip: float | None = None
    lpips_alex: float | None = None
    lpips_vgg: float | None = None
    e_warp: float | None = None
    temporal_flip: float | None = None
    t_lpips: float | None = None
    flicker: float | None = None
    truth_flicker: float | None = None
    psnr_camera_color: float | None = None
    psnr_half: float | None = None
    ssim_half: float | None = None
    psnr_stored: float | None = None
    ssim_stored: float | None = None
    disoccluded_share: float | None = None
    ghost_share: float | None = None
    psnr_disoccluded: float | None = None


OF_DISOCCLUDED = ("ghost_share", "psnr_disoccluded")
"""Scores of disoccluded pixels. A mean weighs each picture by its number of them, because some pictures have few."""


@dataclass(frozen=True)
class FrameScores:
    """One frame of the stream."""

    index: int  # frame number in the stream
    pts_seconds: float  # presentation time
    kind: str  # key or delta
    bytes: int  # length of the packet's record in the file
    field_bytes: Mapping[str, int]  # bytes by field of the state table
    anchors: int  # of the decoded scene
    free: int  # free Gaussians of the decoded scene; all Gaussians of another method's drawable
    decode_seconds: float  # wall-clock time from the file to the scene on its device
    cameras: Mapping[str, Scores]  # by name of the camera, without those that are absent from the frame
    mean: Scores | None  # of these scores; None without any
    log: Mapping[str, Any]  # the frame's entry in the trainer's log; empty without a log


@dataclass(frozen=True)
class Report:
    """An evaluation."""

    frames: Sequence[FrameScores]  # one entry for each frame, in order
    cameras: Mapping[str, Scores]  # mean over the frames with a picture, by name of the camera
    mean: Scores  # over all pictures
    stream: Mapping[str, Any]  # facts of the file, sizes and the course of PSNR over time (``stream_facts``)
    environment: Mapping[str, Any]  # the machine that rendered


def mean_scores(scores: Iterable[Scores]) -> Scores:
    """The mean of each score without None; None if all are None. See :data:`OF_DISOCCLUDED`."""
    rows = list(scores)
    means = {}
    for entry in fields(Scores):
        known = [row for row in rows if getattr(row, entry.name) is not None]
        values = [getattr(row, entry.name) for row in known]
        weights = [row.disoccluded_share or 0.0 for row in known] if entry.name in OF_DISOCCLUDED else None
        means[entry.name] = float(np.average(values, weights=weights)) if values else None
    return Scores(**means)


def slope(values: Sequence[float]) -> float:
    """Slope of the least-squares line through ``values`` over their index; 0 for fewer than two."""
    return float(np.polyfit(np.arange(len(values)), values, 1)[0]) if len(values) > 1 else 0.0


def psnr_trend(frames: Sequence[FrameScores]) -> dict[str, float | None]:
    """PSNR over the frames, dB: first, last, worst, slope, slope at equal shares, and largest drop from the first."""
    psnrs = [frame.mean.psnr for frame in frames if frame.mean]
    return {
        "psnr_first": psnrs[0],
        "psnr_last": psnrs[-1],
        "psnr_worst": min(psnrs),
        "drift_db_per_frame": slope(psnrs),
        "drift_at_equal_shares_db_per_frame": slope_at_equal_shares(frames),
        "drop_from_first_db": psnrs[0] - min(psnrs),
    }


def slope_at_equal_shares(frames: Sequence[FrameScores]) -> float | None:
    """Slope of PSNR if a camera's share of changed pixels were constant over the frames, at its mean.

    Changed pixels have a lower PSNR than static ones, so PSNR falls as more pixels have changed although neither kind
    gets worse. Frames without a camera that has both kinds of pixels are left out; None if fewer than two remain.
    """
    shares: dict[str, list[float]] = {}
    for frame in frames:
        for name, scores in _with_both_kinds(frame).items():
            shares.setdefault(name, []).append(scores.changed_share)
    means = {name: float(np.mean(values)) for name, values in shares.items()}
    course = [
        float(np.mean([_psnr_at_share(scores, means[name]) for name, scores in found.items()]))
        for frame in frames
        if (found := _with_both_kinds(frame))
    ]
    return slope(course) if len(course) > 1 else None


def _with_both_kinds(frame: FrameScores) -> dict[str, Scores]:
    return {
        name: scores
        for name, scores in frame.cameras.items()
        if scores.psnr_changed is not None and scores.psnr_still is not None
    }


def _psnr_at_share(scores: Scores, share: float) -> float:
    """PSNR if the share ``share`` of the pixels were the changed ones."""
    assert scores.psnr_changed is not None
    assert scores.psnr_still is not None
    changed, still = (10.0 ** (-0.1 * psnr) for psnr in (scores.psnr_changed, scores.psnr_still))
    return float(-10.0 * np.log10(share * changed + (1.0 - share) * still))


def drawing_facts(frames: Sequence[FrameScores]) -> dict[str, float]:
    """Renderings per second, without and with decoding of the frame before each rendering."""
    drawing = float(np.mean([frame.mean.render_seconds for frame in frames if frame.mean]))
    decoding = float(np.mean([frame.decode_seconds for frame in frames]))
    return {
        "decode_seconds": decoding,
        "render_fps": 1.0 / max(drawing, 1e-9),
        "decode_and_render_fps": 1.0 / max(drawing + decoding, 1e-9),
    }


def as_json(report: Report) -> dict[str, Any]:
    """The report as plain values."""
    packets = [frame.bytes for frame in report.frames]
    seconds = [frame.log["total_seconds"] for frame in report.frames if "total_seconds" in frame.log]
    mean = vars(report.mean) | {
        "bytes": float(np.mean(packets)),
        "bytes_with_header": report.stream["total_bytes"] / len(report.frames),
        "free": float(np.mean([frame.free for frame in report.frames])),
        "seconds": float(np.mean(seconds)) if seconds else None,
    }
    frames = [
        {key: value for key, value in vars(frame).items() if key not in ("cameras", "mean", "log")}
        | ({entry.name: None for entry in fields(Scores)} if frame.mean is None else vars(frame.mean))
        | {"cameras": {name: vars(scores) for name, scores in frame.cameras.items()}}
        | {"log": dict(frame.log)}
        for frame in report.frames
    ]
    return {
        "mean": mean,
        "cameras": {name: vars(scores) for name, scores in report.cameras.items()},
        "stream": dict(report.stream),
        "environment": dict(report.environment),
        "frames": frames,
    }


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes ``content`` as JSON atomically; creates the folder if it is missing. Raises StorageError if the file
    cannot be written."""
    atomic_write(path, json_text(content).encode(), new_folder=True)


def json_text(content: Mapping[str, Any]) -> str:
    """``content`` as JSON with a line end."""
    return f"{json.dumps(content, indent=1, allow_nan=False)}\n"
