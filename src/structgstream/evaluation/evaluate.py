# SPDX-License-Identifier: Apache-2.0
"""Evaluates a stream from its file: decodes it, renders held-out views, and compares them with the capture, also at
other sizes than that of training, because a player shows streams at the size of its screen."""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from structgstream.cameras import Camera
from structgstream.codec.contents import PacketInfo
from structgstream.codec.packets import PacketKind
from structgstream.data.source import FrameSource, select_cameras
from structgstream.errors import CaptureError, ConfigError
from structgstream.evaluation.environment import environment
from structgstream.evaluation.ghosts import Ghosts, GhostSearch
from structgstream.evaluation.metrics import (
    ChannelFit,
    Mask,
    Picture,
    blackened,
    both,
    channel_fit,
    counting,
    psnr,
    score,
    ssim,
)
from structgstream.evaluation.optional_metrics import (
    OF_WHOLE_PICTURES,
    ComparedFrame,
    MetricSelection,
    OptionalMetrics,
    load_optional_metrics,
    optional_scores,
)
from structgstream.evaluation.pictures import block_mask, block_means, spread_indices
from structgstream.evaluation.recording import (
    Recording,
    check_same_frames,
    check_same_rig,
    comparison_facts,
    scored_cameras,
    stream_facts,
    to_device,
    training_facts,
)
from structgstream.evaluation.report import FrameScores, Report, Scores, drawing_facts, mean_scores, psnr_trend
from structgstream.evaluation.worst import worst_facts
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.memory import PeakMeter
from structgstream.scene.render import Drawable, render_picture
from structgstream.session.frame_report import counts

STORED_FRAMES, STORED_SHARE = 5, 4
"""At most five frames, and at most one in four but at least one, are scored at the stored size: twice the size has four
times the pixels."""


def halved(camera: Camera) -> Camera:
    """The camera of a picture at exactly half the size, without a last row or column that is odd."""
    half = torch.diag(torch.tensor([0.5, 0.5, 1.0], dtype=torch.float64))
    return replace(camera, K=half @ camera.K, width=camera.width // 2, height=camera.height // 2)


def half_scores(
    scene: Drawable, camera: Camera, truth: Picture, *, backend: Backend, mask: Mask | None = None
) -> dict[str, float | None]:
    """PSNR and SSIM, by their names in ``Scores``, of a rendering at half the size of ``camera`` (scene units) against
    the area mean of the truth ``[H, W, 3]``, which is black outside ``mask`` ``[H, W]``, the pixels that count."""
    small = None if mask is None else block_mask(mask, 2)
    return _psnr_and_ssim(scene, halved(camera), block_means(truth, 2), small, backend, size="half")


def stored_scores(
    scene: Drawable, camera: Camera, truth: Picture, *, backend: Backend, mask: Mask | None = None
) -> dict[str, float | None]:
    """The same at the size of a stored picture ``[H, W, 3]``, which is larger than that of ``camera``."""
    view = camera.resized(truth.shape[1], truth.shape[0])
    return _psnr_and_ssim(scene, view, blackened(truth, mask), mask, backend, size="stored")


def frames_at_stored_size(frames: int) -> list[int]:
    """The evenly spread frames, of so many, that are scored at the size of the stored pictures."""
    count = max(1, min(STORED_FRAMES, frames // STORED_SHARE))
    return spread_indices(frames, count) if count > 1 else [frames - 1]


def _psnr_and_ssim(
    scene: Drawable, camera: Camera, truth: Picture, mask: Mask | None, backend: Backend, *, size: str
) -> dict[str, float | None]:
    if not truth.size or (mask is not None and not mask.any()):
        return {f"psnr_{size}": None, f"ssim_{size}": None}
    picture = blackened(render_picture(scene, camera, backend), mask)
    return {f"psnr_{size}": psnr(picture, truth, mask), f"ssim_{size}": ssim(picture, truth, backend, mask)}


@dataclass(frozen=True)
class Compared:
    """One camera of one frame: ground truth, rendering and scores."""

    camera: str
    truth: Picture  # [H, W, 3] picture of the camera, black in masked pixels
    picture: Picture  # [H, W, 3] rendering, black in masked pixels
    scores: Scores  # scores of the rendering
    first: Picture  # the camera's first picture
    counting: Mask | None  # [H, W], the pixels that count in this picture and in first; None for all
    ghosts: Ghosts | None  # ghosts of the rendering (ghosts.py); None if the camera's background is not known


EVALUATION = "evaluation"
"""Name of the scoring stage in measurements of memory."""


def evaluate(
    recording: Recording,
    source: FrameSource,
    *,
    backend: Backend,
    cameras: tuple[str, ...] | None = None,
    log: Mapping[int, Mapping[str, Any]] | None = None,
    observer: Callable[[int, Compared], None] | None = None,
    metrics: MetricSelection = "all",
    lpips_weights: Path | None = None,
    stored: FrameSource | None = None,
) -> Report:
    """Scores of every frame of the file against the capture.

    Args:
        recording: the opened file: a ``StreamReader``, or another method's (``recording.py``).
        source: the capture, cut and scaled as it was for the reconstruction.
        cameras: names of the cameras to score; None for the held-out ones.
        log: the trainer's log by frame number (``run_log.read_log``).
        observer: called with frame number and comparison for every picture.
        metrics: "basic" leaves out the metrics that take longer than rendering: MS-SSIM, FLIP, LPIPS, temporal ones.
        lpips_weights: folder or file with the weights of LPIPS (``lpips.py``, Note [Weights]).
        stored: the same frames at the capture's own, larger size (``recording.captures_of``); None to leave out these
            scores.

    Raises:
        CaptureError: the capture is not the stream's: a camera is missing, has another calibration or picture size, or
            the frames differ.
        ConfigError: there is no camera to score, or weights for LPIPS are wrong.
        StreamError: a packet is damaged.
    """
    if metrics not in get_args(MetricSelection):
        raise ConfigError(f"metrics is one of {', '.join(get_args(MetricSelection))}; got {metrics!r}.")
    names, size = scored_cameras(recording.header, cameras), len(recording.packets)
    check_same_rig(recording.header, source, names)
    check_same_frames(recording, source)
    views = {name: recording.header.camera(name) for name in names}
    optional_metrics = None
    if metrics == "all":
        optional_metrics = load_optional_metrics(
            views.items(), frames=size, device=backend.device, lpips_weights=lpips_weights
        )
    selected = select_cameras(source, names)
    large = None if stored is None else select_cameras(stored, names)
    in_large = [] if large is None else frames_at_stored_size(size)
    comparison = _Comparison(views, backend, optional_metrics, GhostSearch(selected, names, size))
    frames = []
    peaks = PeakMeter(backend.device)
    for frame, (info, scene, decode_seconds) in zip(selected.frames(), decoded(recording, backend.device)):
        compared = []
        stored_frame = next(large.frames(info.index)) if large is not None and info.index in in_large else None
        for name in frame.present(names):
            compared.append(comparison.compare(name, scene, frame, index=info.index, stored=stored_frame))
            if observer is not None:
                observer(info.index, compared[-1])
        frames.append(_frame_scores(info, scene, compared, decode_seconds, dict((log or {}).get(info.index, {}))))
    if recording.packets and not any(frame.cameras for frame in frames):
        raise CaptureError(
            f"No frame of the capture {source.name} has a picture of {' or '.join(names)}; name other cameras with "
            "--cameras."
        )
    seen = [name for name in names if any(name in frame.cameras for frame in frames)]
    by_camera = {name: mean_scores(frame.cameras[name] for frame in frames if name in frame.cameras) for name in seen}
    mean = mean_scores(scores for frame in frames for scores in frame.cameras.values())
    left_out = comparison_facts(frames, names, comparison.left_out)
    facts = {
        **stream_facts(recording, names),
        **psnr_trend(frames),
        **left_out,
        **training_facts(frame.log for frame in frames),
        **drawing_facts(frames),
        "worst": worst_facts(frames),
        "stored_size_frames": in_large,
        "camera_colors": {name: vars(fit) for name, fit in comparison.colors.items()},
        "metrics": metrics,
        "not_available": _not_available(optional_metrics, left_out["masked_share"]),
        "lpips_weights": dict(optional_metrics.weights) if optional_metrics else {},
    }
    peaks.end(EVALUATION)
    machine = {
        **environment(),
        "backend": backend.name,
        "peak_memory_bytes": peaks.process_bytes.get(EVALUATION),
        "peak_device_bytes": peaks.device_bytes.get(EVALUATION),
        "peak_memory_kind": str(peaks.kind),
    }
    return Report(frames, by_camera, mean, facts, machine)


@dataclass
class _Comparison:
    """Compares renderings with pictures frame by frame, and stores what scores need of each camera's earlier frames."""

    views: Mapping[str, Camera]
    backend: Backend
    optional_metrics: OptionalMetrics | None  # the metrics that take longer; None for none
    ghosts: GhostSearch  # finds ghosts
    # each camera's first picture, and its mask
    first: dict[str, tuple[Picture, Mask | None]] = field(default_factory=dict)
    colors: dict[str, ChannelFit] = field(default_factory=dict)  # each camera's colour response, fitted to frame 0
    # each camera's last frame and its number, for temporal metrics
    before: dict[str, tuple[int, ComparedFrame]] = field(default_factory=dict)
    left_out: dict[str, list[float]] = field(default_factory=dict)  # each camera's share of masked pixels, by frame

    def compare(
        self, camera: str, scene: Drawable, frame: MultiViewFrame, *, index: int, stored: MultiViewFrame | None
    ) -> Compared:
        """The rendering of frame ``index`` by ``camera``, and its scores over the pixels of the camera's mask; also at
        the size of a ``stored`` frame.

        Both pictures are black in the other pixels, so that these do not affect the scores of their neighbours.
        """
        mask = frame.masks.get(camera)
        truth = blackened(frame.images[camera], mask)
        first, first_mask = self.first.setdefault(camera, (truth, mask))
        view, backend = self.views[camera], self.backend
        picture, seconds = rendered(scene, view, backend)
        picture = blackened(picture, mask)
        if camera not in self.colors:
            self.colors[camera] = channel_fit(*counting(mask, picture, truth))
        scores = score(
            picture,
            truth,
            first,
            backend=backend,
            seconds=seconds,
            color=self.colors[camera],
            mask=mask,
            first_mask=first_mask,
        )
        ghosts, more = self.ghosts.find(camera, picture, truth, index=index, mask=mask), dict[str, float | None]()
        if min(truth.shape[:2]) > 1:
            more |= half_scores(scene, view, truth, backend=backend, mask=mask)
        if stored is not None:
            if camera not in stored.images:
                raise CaptureError(f"The stored picture of camera {camera!r} in frame {index} has gone; restore it.")
            large, large_mask = stored.images[camera], stored.masks.get(camera)
            more |= stored_scores(scene, view, large, backend=backend, mask=large_mask)
        if ghosts is not None:
            more |= {"disoccluded_share": ghosts.disoccluded_share, "ghost_share": ghosts.share}
            more["psnr_disoccluded"] = ghosts.psnr
        self.left_out.setdefault(camera, []).append(0.0 if mask is None else 1.0 - float(mask.mean()))
        if self.optional_metrics is not None:
            number, last = self.before.get(camera, (-1, None))
            further, now = optional_scores(
                self.optional_metrics,
                truth=truth,
                picture=picture,
                before=last if number == index - 1 else None,
                mask=mask,
            )
            self.before[camera] = index, now
            more |= further
        scores = replace(scores, **more)
        return Compared(camera, truth, picture, scores, first, both(mask, first_mask), ghosts)


def _not_available(metrics: OptionalMetrics | None, masked_share: Mapping[str, float]) -> dict[str, str]:
    """Reasons for missing scores; a metric that is not available at all takes precedence over masks."""
    if metrics is None:
        return {}
    reason = f"masks leave out pixels of {', '.join(masked_share)}, and this score compares whole pictures"
    return (dict.fromkeys(OF_WHOLE_PICTURES, reason) if masked_share else {}) | dict(metrics.not_available)


def decoded(recording: Recording, device: torch.device) -> Iterator[tuple[PacketInfo, Drawable, float]]:
    """Every frame on ``device``, with the seconds of reading, decoding and copying it."""
    began = time.perf_counter()
    for info, drawable in recording.scenes(0):
        drawable = to_device(drawable, device)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        yield info, drawable, time.perf_counter() - began
        began = time.perf_counter()


def rendered(scene: Drawable, camera: Camera, backend: Backend) -> tuple[Picture, float]:
    """The 8-bit picture of ``camera`` (scene units), and the seconds until it was in main memory."""
    began = time.perf_counter()
    picture = render_picture(scene, camera, backend)
    return picture, time.perf_counter() - began


def compared_frames(
    recording: Recording, source: FrameSource, *, backend: Backend, camera: str
) -> Iterator[tuple[Picture, Picture]]:
    """Truth and rendering of one camera, frame by frame; both black in frames that the camera is absent from.

    Raises:
        CaptureError: see :func:`evaluate`.
    """
    check_same_rig(recording.header, source, (camera,))
    check_same_frames(recording, source)
    view = recording.header.camera(camera)
    for frame, (_, scene) in zip(select_cameras(source, (camera,)).frames(), recording.scenes(0)):
        picture = rendered(to_device(scene, backend.device), view, backend)[0]
        truth = frame.images.get(camera)
        yield (np.zeros_like(picture), np.zeros_like(picture)) if truth is None else (truth, picture)


def _frame_scores(
    info: PacketInfo, scene: Drawable, compared: list[Compared], decode_seconds: float, log: dict[str, Any]
) -> FrameScores:
    scores = {entry.camera: entry.scores for entry in compared}
    return FrameScores(
        index=info.index,
        pts_seconds=info.pts_seconds,
        kind=PacketKind(info.kind).name.lower(),
        bytes=info.bytes,
        field_bytes=dict(info.field_bytes),
        **counts(scene),
        decode_seconds=decode_seconds,
        cameras=scores,
        mean=mean_scores(scores.values()) if scores else None,
        log=log,
    )
