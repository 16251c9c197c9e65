# SPDX-License-Identifier: Apache-2.0
"""Writes tiny captures in every layout; each picture carries its camera's and its frame's number."""

import json
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from tests.support.rigs import arc_rig

Picture = NDArray[np.uint8]
WIDTH, HEIGHT = 64, 48
TICKS = 30000  # a second; exact for 30 and for 30000/1001 frames a second
LUMA = {1: (0.2126, 0.7152, 0.0722), 5: (0.299, 0.587, 0.114)}  # weights of BT.709 and BT.601
LIMITED, FULL = 1, 2


def picture(camera: int, frame: int, *, width: int = WIDTH, height: int = HEIGHT) -> Picture:
    """A picture with ``camera`` (4 bits) in its upper half and ``frame`` (8 bits) in its lower one."""
    bits = np.full((2, 8), 40, np.uint8)
    bits[0] += np.array([150 * (camera >> bit & 1) for bit in range(8)], np.uint8)
    bits[1] += np.array([150 * (frame >> bit & 1) for bit in range(8)], np.uint8)
    grey = cv2.resize(bits, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def numbers(image: Picture) -> tuple[int, int]:
    """The camera and the frame that a picture carries, at any size."""
    blocks = cv2.resize(image, (8 * 8, 2 * 8), interpolation=cv2.INTER_AREA).mean(axis=2)
    bits = blocks.reshape(2, 8, 8, 8)[:, 2:6, :, 2:6].mean(axis=(1, 3)) > 115
    camera, frame = (sum(1 << bit for bit in range(8) if row[bit]) for row in bits)
    return camera, frame


def all_numbers(frames: Sequence[object] | object) -> list[list[tuple[int, int]]]:
    """For every frame, what its pictures carry, in rig order."""
    return [[numbers(image) for image in frame.images.values()] for frame in frames]  # type: ignore[attr-defined]


def yuv_planes(rgb: Picture, *, matrix: int, color_range: int, subsampled: bool) -> list[Picture]:
    """Luma and the two chroma planes by the definition of the matrix (ITU-R BT.601 and BT.709)."""
    red, _, blue = LUMA[matrix]
    x = rgb / 255.0
    luma = x @ LUMA[matrix]
    chroma = np.stack([(x[..., 2] - luma) / (2 - 2 * blue), (x[..., 0] - luma) / (2 - 2 * red)])
    if subsampled:
        chroma = chroma.reshape(2, chroma.shape[1] // 2, 2, chroma.shape[2] // 2, 2).mean(axis=(2, 4))
    y = 255 * luma if color_range == FULL else 16 + 219 * luma
    uv = 128 + (255 if color_range == FULL else 224) * chroma
    return [np.rint(plane).clip(0, 255).astype(np.uint8) for plane in (y, *uv)]


def write_video(
    path: Path,
    pictures: Sequence[Picture],
    *,
    instants: Sequence[float] | None = None,
    fps: float = 30,
    matrix: int | None = 1,
    color_range: int | None = LIMITED,
    pixels: str = "yuv444p",
    options: Mapping[str, str] | None = None,
) -> None:
    """A lossless H.264 file with short groups; ``instants`` are times in frames, ``options`` of libx264."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = pictures[0].shape[:2]
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        own = {"qp": "0", "g": "4", "bf": "2", "preset": "fast", "threads": "1", **(options or {})}
        stream = container.add_stream("libx264", rate=round(fps), options=own)
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        stream.codec_context.time_base = Fraction(1, TICKS)
        if matrix is not None:
            stream.codec_context.colorspace = matrix
        if color_range is not None:
            stream.codec_context.color_range = color_range
        for number, image in enumerate(pictures):
            frame = av.VideoFrame(width, height, pixels)
            planes = yuv_planes(
                image, matrix=matrix or 5, color_range=color_range or LIMITED, subsampled=pixels == "yuv420p"
            )
            for plane, values in zip(frame.planes, planes, strict=True):
                padded = np.zeros((plane.height, plane.line_size), np.uint8)
                padded[:, : plane.width] = values
                plane.update(padded.tobytes())
            if matrix is not None:
                frame.colorspace = matrix
            if color_range is not None:
                frame.color_range = color_range
            frame.pts = round((number if instants is None else instants[number]) * TICKS / fps)
            frame.time_base = Fraction(1, TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_videos(folder: Path, names: Sequence[str], *, frames: int = 6, fps: float = 30) -> None:
    """One numbered video per camera."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        (folder / f"{name}.mp4").write_bytes(_numbered_video(number, frames, fps))


@cache
def _numbered_video(camera: int, frames: int, fps: float) -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder, "video.mp4")
        write_video(path, [picture(camera, frame) for frame in range(frames)], fps=fps)
        return path.read_bytes()


def write_picture(path: Path, image: Picture) -> None:
    """A picture file, with quality enough for its numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def write_pictures(folder: Path, pattern: str, names: Iterable[str], *, frames: int) -> None:
    """Pictures of each camera and frame, at ``pattern`` with CAM and FRAME, of six digits, replaced."""
    for camera, name in enumerate(names):
        for frame in range(frames):
            file = pattern.replace("CAM", name).replace("FRAME", f"{frame:06d}")
            write_picture(folder / file, picture(camera, frame))


def edit_json(file: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes the content of a JSON file."""
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def small_rig(cameras: int = 4) -> CameraRig:
    """Cameras on an arc whose pictures have the size of :func:`picture`."""
    return arc_rig(cameras, width=WIDTH, height=HEIGHT)


def write_panoptic(path: Path, *, cameras: int = 4, frames: int = 5, first: int = 90) -> CameraRig:
    """The PanopticSports layout; camera ``0`` is held out. Ids are decimal, as in the real captures."""
    rig = small_rig(cameras)
    path.mkdir(parents=True, exist_ok=True)
    for meta, ids in (("train_meta.json", range(1, cameras)), ("test_meta.json", range(1))):
        views = [rig[f"cam{number:02d}"] for number in ids]
        content = {
            "w": WIDTH,
            "h": HEIGHT,
            "k": [[view.K.tolist() for view in views]] * frames,
            "w2c": [[view.viewmat.tolist() for view in views]] * frames,
            "fn": [[f"{number}/{first + frame:06d}.jpg" for number in ids] for frame in range(frames)],
            "cam_id": [list(ids)] * frames,
        }
        (path / meta).write_text(json.dumps(content))
        for number in ids:
            for frame in range(frames):
                write_picture(path / "ims" / f"{number}/{first + frame:06d}.jpg", picture(number, frame))
    return rig


def write_clip(path: Path, *, cameras: int = 4, frames: int = 6, fps: float = 30) -> CameraRig:
    """The package's own JSON layout; ``cam00`` is held out."""
    rig = small_rig(cameras)
    write_videos(path, list(rig), frames=frames, fps=fps)
    content = {
        "width": WIDTH,
        "height": HEIGHT,
        "fps": fps,
        "frames": frames,
        "near": 0.2,
        "held_out": sorted(rig.held_out),
        "cameras": {name: {"K": rig[name].K.tolist(), "viewmat": rig[name].viewmat.tolist()} for name in rig},
    }
    (path / "cameras.json").write_text(json.dumps(content))
    return rig


def write_shared_intrinsics(path: Path, *, cameras: int = 3, frames: int = 4) -> CameraRig:
    """The JSON layout with one set of intrinsics and camera-to-world matrices."""
    rig = small_rig(cameras)
    write_videos(path, list(rig), frames=frames)
    K = rig["cam00"].K
    content = {
        "w": WIDTH, "h": HEIGHT, "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]),
        "cy": float(K[1, 2]), "cams": [rig[name].viewmat.inverse().tolist() for name in rig],
    }  # fmt: skip
    (path / "cameras.json").write_text(json.dumps(content))
    return rig


def write_n3dv(
    path: Path, *, cameras: int = 4, frames: int = 6, size: float = 1.0, skip: int = 2, pattern: str = "cam{:02d}"
) -> CameraRig:
    """The N3DV layout, without a video numbered ``skip``; poses are for ``size`` times the videos' pixels."""
    rig = small_rig(cameras)
    names = [pattern.format(number) for number in range(cameras + 1) if number != skip]
    write_videos(path, names, frames=frames)
    rows = []
    for camera in rig.cameras.values():
        pose = camera.viewmat.inverse().numpy()
        right, down, forward, center = pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3]
        hwf = np.array([HEIGHT * size, WIDTH * size, float(camera.K[0, 0]) * size])
        rows.append(np.concatenate([np.stack([down, right, -forward, center, hwf], axis=1).ravel(), [0.5, 9.0]]))
    np.save(path / "poses_bounds.npy", np.array(rows))
    return CameraRig({name: rig[old] for name, old in zip(names, rig)}, frozenset(names[:1]))


def write_meet_room(path: Path) -> CameraRig:
    """As N3DV, with names of its own: thirteen cameras, of which ``cam_10`` follows ``cam_9``."""
    return write_n3dv(path, cameras=13, skip=13, pattern="cam_{}")


IMMERSIVE_RADIAL = [0.02, -0.003]


def write_immersive(path: Path, *, cameras: int = 4, frames: int = 3) -> CameraRig:
    """The layout of Google Immersive: fisheye videos of half the pixels that ``models.json`` is for.

    The rig is that of the pinholes, of half the fisheye's focal length, whose pictures are those of :func:`picture`.
    """
    width, height, focal = 4 * WIDTH, 4 * HEIGHT, 80.0
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    centers = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64).reshape(-1, 1, 2)
    rays = cv2.fisheye.undistortPoints(centers, K, np.array([*IMMERSIVE_RADIAL, 0, 0])).reshape(height, width, 2)
    maps = (rays * focal / 2 + K[:2, 2]).astype(np.float32)
    rig, entries, made = small_rig(cameras), [], {}
    for number, camera in enumerate(rig.cameras.values()):
        name = f"camera_{number + 1:04d}"
        pictures = [picture(number, frame, width=width, height=height) for frame in range(frames)]
        filmed = [cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR) for image in pictures]
        write_video(path / f"{name}.mp4", [image.astype(np.uint8) for image in filmed])
        entries.append(
            {
                "name": name,
                "width": 2.0 * width,
                "height": 2.0 * height,
                "focal_length": 2 * focal,
                "principal_point": [width - 0.5, height - 0.5],
                "radial_distortion": [*IMMERSIVE_RADIAL, 0.7],
                "orientation": cv2.Rodrigues(camera.viewmat[:3, :3].numpy())[0].ravel().tolist(),
                "position": camera.center.tolist(),
                "projection_type": "fisheye",
            }
        )
        pinhole = np.array([[focal / 2, 0, width / 2], [0, focal / 2, height / 2], [0, 0, 1]])
        made[name] = Camera(camera.viewmat, torch.from_numpy(pinhole), width, height)
    (path / "models.json").write_text(json.dumps(entries))
    return CameraRig(made, frozenset({"camera_0001"}))


def quaternion(camera: Camera) -> list[float]:
    """(w, x, y, z) of the rotation, by the eigenvector method."""
    r = camera.viewmat[:3, :3].numpy()
    k = np.zeros((4, 4))
    k[0] = [np.trace(r), r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    k[:, 0] = k[0]
    k[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    return np.linalg.eigh(k)[1][:, -1].tolist()


def write_text_model(
    folder: Path,
    rig: CameraRig,
    images: Sequence[tuple[str, str]],
    *,
    points: NDArray[np.float64] | None = None,
) -> None:
    """A COLMAP text model; ``images`` are pairs of a file name and the camera of the rig that took it."""
    folder.mkdir(parents=True, exist_ok=True)
    ids = {name: number for number, name in enumerate(rig, start=1)}
    lines = ["# cameras"]
    for name, camera in rig.cameras.items():
        K = camera.K
        params = " ".join(str(float(value)) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        lines.append(f"{ids[name]} PINHOLE {camera.width} {camera.height} {params}")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# images"]
    for number, (file, name) in enumerate(images, start=1):
        pose = [*quaternion(rig[name]), *rig[name].viewmat[:3, 3].tolist()]
        lines += [
            f"{number} {' '.join(map(str, pose))} {ids[name]} {file}",
            "" if number % 2 else "1.5 2.5 -1",
        ]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{i} {x} {y} {z} 9 9 9 0.5 1 0 2 0" for i, (x, y, z) in enumerate(points if points is not None else [])]
    (folder / "points3D.txt").write_text("\n".join(["# points", *rows]) + "\n")


def write_binary_model(
    folder: Path, rig: CameraRig, images: Sequence[tuple[str, str]], *, points: NDArray[np.float64]
) -> None:
    """As :func:`write_text_model`, in the binary format; camera 2 is a SIMPLE_PINHOLE."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = struct.pack("<Q", len(rig))
    for number, camera in enumerate(rig.cameras.values(), start=1):
        fx, fy, cx, cy = (float(camera.K[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))
        params = (fx, cx, cy) if number == 2 else (fx, fy, cx, cy)
        cameras += struct.pack(f"<iiQQ{len(params)}d", number, number != 2, camera.width, camera.height, *params)
    pictures = struct.pack("<Q", len(images))
    ids = {name: number for number, name in enumerate(rig, start=1)}
    for number, (file, name) in enumerate(images, start=1):
        pose = (*quaternion(rig[name]), *rig[name].viewmat[:3, 3].tolist())
        pictures += struct.pack("<i7di", number, *pose, ids[name]) + file.encode() + b"\0"
        pictures += struct.pack("<Q", number) + struct.pack("<ddq", 1.5, 2.5, -1) * number
    places = struct.pack("<Q", len(points))
    for number, point in enumerate(points):
        places += struct.pack("<Q3d3BdQ", number, *point, 9, 9, 9, 0.5, number) + struct.pack("<ii", 1, 0) * number
    (folder / "cameras.bin").write_bytes(cameras)
    (folder / "images.bin").write_bytes(pictures)
    (folder / "points3D.bin").write_bytes(places)
