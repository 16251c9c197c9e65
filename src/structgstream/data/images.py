# SPDX-License-Identifier: Apache-2.0
"""Captures whose frames are picture files: one list of files per camera."""

import os
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.timeline import common_slots, natural
from structgstream.errors import CalibrationError, CaptureError, MissingExtraError
from structgstream.frames import MultiViewFrame

PICTURE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})


@dataclass(frozen=True)
class ImageSource:
    """A :class:`~structgstream.data.source.FrameSource` over picture files.

    Args:
        name: the capture's name.
        rig: its cameras, at the size of the pictures.
        fps: frames a second.
        files: camera name to its picture in each frame; None where it has none.
        points: ``[P, 3]`` points that came with the capture, or None.
        instants: name of each frame in the files; empty if frames have no names.
        apart_seconds: camera name to how long after its instant its picture of each frame was taken, ``[N]``; empty
            where that is not known.
    """

    name: str
    rig: CameraRig
    fps: float
    files: Mapping[str, tuple[Path | None, ...]]
    points: NDArray[np.float64] | None = None
    instants: tuple[str, ...] = ()
    apart_seconds: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def __len__(self) -> int:
        return min(len(files) for files in self.files.values())

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """The frames from stream index ``start``; the pictures of one instant are read in parallel.

        Raises:
            CaptureError: a picture has gone, cannot be decoded, or has another size than its intrinsics.
        """
        opencv()  # missing, it is told once
        with ThreadPoolExecutor(min(len(self.rig), os.cpu_count() or 1), "pictures") as pool:
            for index in range(start, len(self)):
                paths = {name: path for name in self.rig if (path := self.files[name][index]) is not None}
                pictures = pool.map(_picture, paths.values(), [self.rig[name] for name in paths])
                yield MultiViewFrame(index, index / self.fps, dict(zip(paths, pictures, strict=True)))


def opencv() -> ModuleType:
    """The module ``cv2``, from the extra ``capture``."""
    try:
        import cv2
    except ImportError:
        raise MissingExtraError("cv2", "capture") from None
    return cv2


class CommonPictures(NamedTuple):
    """The pictures of a capture's frames.

    Args:
        files: camera name to its picture in each frame; None where it has none.
        instants: name of each frame.
    """

    files: dict[str, tuple[Path | None, ...]]
    instants: tuple[str, ...]


def common_pictures(
    files: Mapping[str, Mapping[str, Path]], *, where: Path, training: Collection[str] | None = None
) -> CommonPictures:
    """The pictures of the time steps of a capture, of which cameras may lack some.

    Args:
        files: camera name to its pictures, by the name of the instant.
        where: the capture, for messages.
        training: names of the cameras that are not held out; None for all.

    Raises:
        CaptureError: see :func:`~structgstream.data.timeline.common_slots`.
    """
    instants = sorted({instant for pictures in files.values() for instant in pictures}, key=natural)
    slot_of = {instant: slot for slot, instant in enumerate(instants)}
    slots = {camera: sorted(slot_of[instant] for instant in pictures) for camera, pictures in files.items()}
    common = common_slots(slots, where=str(where), label=lambda slot: f"frame {instants[slot]!r}", training=training)
    return CommonPictures(
        {camera: tuple(pictures.get(instants[slot]) for slot in common) for camera, pictures in files.items()},
        tuple(instants[slot] for slot in common),
    )


def read_picture(path: Path) -> NDArray[np.uint8]:
    """One picture as ``[H, W, 3]`` sRGB, as its pixels are stored.

    Raises:
        CaptureError: it cannot be read or decoded.
    """
    cv2 = opencv()
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"The picture {path} cannot be read ({error.strerror}); restore it.") from None
    picture = None
    # A cut JPEG decodes to a picture that is grey below the cut, so look for its end marker (byte stuffing
    # keeps the marker out of the picture's data).
    cut = data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-4096:]
    if data and not cut:
        # Calibrations are made on the stored pixels, so a rotation tag must not turn them.
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if picture is None:
        raise CaptureError(
            f"The picture {path} cannot be decoded ({len(data)} bytes, empty, cut or damaged); restore it, or delete "
            "it: its camera then is absent from that frame."
        )
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def _picture(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """One picture, checked against the size of its camera."""
    picture = read_picture(path)
    height, width = picture.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise CalibrationError(
            f"The picture {path} has {width}x{height} pixels, its camera's intrinsics are for "
            f"{camera.width}x{camera.height}; scale the intrinsics, or use the pictures that were calibrated."
        )
    return picture


def reduced_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """``mask`` ``[H, W]`` at another ``size``, width and height: a pixel counts if all that it is made of counts."""
    if mask.shape[1::-1] == size:
        return mask
    cv2 = opencv()
    shrinks = size[0] <= mask.shape[1] and size[1] <= mask.shape[0]
    taken = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return taken > 1 - 1e-4
