# SPDX-License-Identifier: Apache-2.0
"""Makes a stream of a numbered ``.ply`` sequence of another trainer.

Note [Imported sequences]
~~~~~~~~~~~~~~~~~~~~~~~~~
All Gaussians become free Gaussians of a compact stream without anchors, which any player of the format plays. Where all
files have the same Gaussians in the same order, these live on, and packets contain their changes; otherwise every frame
is a key packet with Gaussians of its own. A free Gaussian has one colour: the mean of what cameras see of its spherical
harmonics. The cameras are those of a capture, or a made ring around the Gaussians; they set the first view of players,
the low-pass (``scene/sampling.py``, Note [Drawn as it was trained]) and, with it, the step of positions.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from structgstream.atomic_files import renamed_on_success
from structgstream.cameras import Camera, CameraRig, normalizing_similarity
from structgstream.codec.fields.packet_fields import MAX_FREE
from structgstream.codec.fields.quantization import LARGEST, float32
from structgstream.codec.fields.static_fields import UNCODED_FIELDS
from structgstream.codec.packets import PacketKind, StreamHeader
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import FileSink
from structgstream.errors import CaptureError
from structgstream.evaluation.camera_path import look_at
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.ply import MIN_OPACITY, read_header, read_ply
from structgstream.exporters.write import pictures_psnr
from structgstream.harmonics import Y0
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import HeadWeights, MLPWeights
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.order import morton_order
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, state_of

DYNAMIC: frozenset[FieldName] = frozenset({"free", "free_births"})
POSITION_PIXELS = 0.125
"""Step of positions, in pixels of a camera at the median Gaussian."""
STEPS = {"free_log_scales": 1 / 32, "free_quats": 1 / 128, "free_logit_opacities": 1 / 16, "free_colors": 1 / 256}
MIN_SCALE = 1e-12
"""Least standard deviation along an axis; files have flat Gaussians of 0."""
KEY_INTERVAL_SECONDS = 1.0
MAX_LINKED_SHARE = 0.1
"""Rows of two files are the same Gaussians if their median motion is less than this share of the median distance of
two different Gaussians."""
RING_CAMERAS, RING_DISTANCE, RING_ELEVATION_DEGREES = 8, 3.0, 15.0
RING_SIZE, RING_FOCAL_PIXELS = (1280, 720), 1100.0
_FRAME_BITS = 32


@dataclass(frozen=True)
class ImportedSequence:
    """What became of a sequence."""

    frames: int  # number of frames
    counts: tuple[int, int]  # fewest and most Gaussians of a frame
    far: int  # most Gaussians of a frame that are left out since they are too far away to be coded
    linked: bool  # whether Gaussians live on from frame to frame; else each frame is stored by itself
    degree: int  # degree of the spherical harmonics of the files
    unread: tuple[str, ...]  # properties and elements of the files that a stream does not have
    color_psnr: float  # PSNR, dB, of pictures of frame 0 with one colour for each Gaussian, against the files
    psnr: float  # the same of the stream, which is quantized, too


def import_sequence(
    files: Sequence[Path],
    output: Path,
    *,
    fps: float,
    backend: Backend,
    rig: CameraRig | None = None,
    down: tuple[float, float, float] = (0.0, 1.0, 0.0),
    max_splats: int | None = None,
    on_frame: Callable[[], object] = lambda: None,
) -> ImportedSequence:
    """Writes a stream of ``.ply`` files, one for each frame (Note [Imported sequences]).

    Args:
        rig: cameras in the units of the files; None for a ring around the Gaussians of the first file.
        down: direction of gravity, for the ring.
        max_splats: largest number of Gaussians of a frame, at most :data:`MAX_FREE`; the smallest and most transparent
            are left out. None for all of them.

    Raises:
        CaptureError: a file is not a ``.ply`` of Gaussians, is damaged or has too many Gaussians.
        StorageError: the stream cannot be written.
    """
    headers = [read_header(file) for file in files]
    if len({header.degree for header in headers}) > 1:
        raise CaptureError(
            f"The files of {files[0].parent} have spherical harmonics of different degrees; expected one."
        )
    if empty := [file.name for file, header in zip(files, headers, strict=True) if not header.count]:
        raise CaptureError(f"{empty[0]} has no Gaussian.")
    largest = max(header.count for header in headers)
    if max_splats is None and largest > MAX_FREE:
        raise CaptureError(
            f"A frame has {largest:,} Gaussians, and a stream at most {MAX_FREE:,}; add --max-splats {MAX_FREE}."
        )
    first = read_ply(files[0])
    rig = rig or ring_around(first, down)
    similarity = normalizing_similarity(rig, radius=1.0)
    cameras = [similarity.camera(rig[name]) for name in rig.training]
    sampling = RigSampling.of(similarity.rig(rig))

    def in_scene(gaussians: BakedGaussians) -> BakedGaussians:
        means = similarity.points(gaussians.means.double()).float()
        scales = (gaussians.scales * similarity.scale).clamp(min=MIN_SCALE)
        return replace(gaussians, means=means, scales=scales)

    first = in_scene(first)
    linked = len({header.count for header in headers}) == 1 and (
        len(files) == 1 or same_rows(first.means, in_scene(read_ply(files[1])).means)
    )
    interval = float(sampling.intervals(first.means).median().clamp(min=1e-9))
    position_step = float32(POSITION_PIXELS * interval)
    reach = 0.999 * LARGEST * position_step
    chosen = _chosen(first, max_splats, reach)
    empty = _empty_scene(rig)
    header = StreamHeader(
        rig=rig,
        similarity=similarity,
        fps=fps,
        codec="compact",
        dynamic=DYNAMIC,
        static={name: value for name, value in state_of(empty).items() if name not in DYNAMIC},
        distance_input=False,
        config={"key_interval_seconds": KEY_INTERVAL_SECONDS},
        metadata={"capture": files[0].parent.name, "imported": "ply"},
        steps={"free_means": position_step, **STEPS},
        init_steps={name: 1.0 for name in state_of(empty) if name not in UNCODED_FIELDS},
    )
    encoder, key_interval = SceneEncoder(header), max(1, round(fps * KEY_INTERVAL_SECONDS)) if linked else 1
    psnr = color_psnr = math.inf
    quats = first.quats[chosen]
    counts, far = [], []
    with renamed_on_success(output) as part, closing(FileSink(part, overwrite=True)) as sink:
        sink.open(header)
        for index, file in enumerate(files):
            whole = first if index == 0 else in_scene(read_ply(file))
            gaussians = whole.select(chosen if linked else _chosen(whole, max_splats, reach))
            counts.append(len(gaussians))
            far.append(0 if linked and index else int((whole.means.abs().amax(1) > reach).sum()))
            if linked:  # a quaternion and its negative are the same rotation
                same_side = torch.where((gaussians.quats * quats).sum(1, keepdim=True) < 0, -1.0, 1.0)
                quats = gaussians.quats * same_side
                gaussians = replace(gaussians, quats=quats)
            births = torch.arange(len(gaussians)) + (0 if linked else index << _FRAME_BITS)
            scene = replace(empty, free=_free(gaussians, cameras, births, reach), sampling=sampling)
            kind = PacketKind.DELTA if index % key_interval else PacketKind.KEY
            encoded = encoder.encode(scene, index=index, pts_seconds=index / fps, kind=kind)
            sink.write(encoded.packet)
            if index == 0:
                decoded = replace(encoded.reconstruction, sampling=sampling)
                color_psnr = pictures_psnr(whole, scene, cameras, backend)
                psnr = pictures_psnr(whole, decoded, cameras, backend)
            on_frame()
    unread = tuple(dict.fromkeys(name for header in headers for name in header.unread))
    seen = (min(counts), max(counts))
    return ImportedSequence(len(files), seen, max(far), linked, first.degree, unread, color_psnr, psnr)


def same_rows(before: Tensor, after: Tensor) -> bool:
    """Whether rows ``[N, 3]`` of two frames are the same Gaussians in the same order, judged by how far they move."""
    moved = (after - before).norm(dim=1).median()
    return bool(moved < MAX_LINKED_SHARE * (after.roll(len(after) // 2 or 1, dims=0) - before).norm(dim=1).median())


def ring_around(gaussians: BakedGaussians, down: tuple[float, float, float]) -> CameraRig:
    """Cameras on a ring around the Gaussians, slightly above, that look at their middle."""
    middle = gaussians.means.median(0).values.double()
    radius = float((gaussians.means - middle).norm(dim=1).quantile(0.9).clamp(min=1e-6))
    vertical = torch.nn.functional.normalize(torch.tensor(down, dtype=torch.float64), dim=0)
    side = torch.linalg.cross(vertical, torch.eye(3, dtype=torch.float64)[int(vertical.abs().argmin())])
    side = torch.nn.functional.normalize(side, dim=0)
    depth, up = torch.linalg.cross(vertical, side), math.radians(RING_ELEVATION_DEGREES)
    width, height = RING_SIZE
    K = torch.tensor([[RING_FOCAL_PIXELS, 0, width / 2], [0, RING_FOCAL_PIXELS, height / 2], [0, 0, 1]])
    cameras = {}
    for number in range(RING_CAMERAS):
        angle = 2.0 * math.pi * number / RING_CAMERAS
        level = math.cos(angle) * side + math.sin(angle) * depth
        eye = middle - RING_DISTANCE * radius * (math.sin(up) * vertical - math.cos(up) * level)
        viewmat = look_at(eye, middle, vertical)
        cameras[f"view{number}"] = Camera(viewmat, K, width, height, near=radius / 100.0)
    return CameraRig(cameras)


def _chosen(gaussians: BakedGaussians, max_splats: int | None, reach: float) -> Tensor:
    """Rows of the most important Gaussians within ``reach`` along each axis, neighbours in space next to each other."""
    rows = gaussians.by_importance()
    rows = rows[gaussians.means[rows].abs().amax(1) <= reach][:max_splats]
    return rows[morton_order(gaussians.means[rows])]


def _free(gaussians: BakedGaussians, cameras: Sequence[Camera], births: Tensor, reach: float) -> FreeGaussians:
    seen = [gaussians.colors(camera.center.to(gaussians.means)) for camera in cameras] if gaussians.degree else []
    colors = torch.stack(seen).mean(0) if seen else 0.5 + Y0 * gaussians.sh[:, 0]
    return FreeGaussians(
        means=gaussians.means.clamp(-reach, reach),
        log_scales=gaussians.scales.log(),
        quats=gaussians.quats,
        logit_opacities=gaussians.opacities.clamp(MIN_OPACITY, 1.0 - MIN_OPACITY).logit(),
        colors=colors.clamp(min=0.0),
        births=births,
    )


def _empty_scene(rig: CameraRig) -> Scene:
    """A scene without Gaussians, with the smallest MLPs that the format allows."""
    inputs = 4  # a feature and a direction

    def head(outputs: int) -> HeadWeights:
        return HeadWeights(torch.zeros(1, inputs), torch.zeros(1), torch.zeros(outputs, 1), torch.zeros(outputs))

    nothing = torch.zeros(0, 3)
    return Scene(
        anchors=AnchorCloud(nothing, nothing, nothing, torch.zeros(0, 1, 3), torch.zeros(0, 1)),
        mlps=MLPWeights(opacity=head(1), color=head(3), covariance=head(7)),
        free=FreeGaussians.empty(),
        camera_color=CameraColor.identity(len(rig.training)),
        distance_input=False,
    )
