# SPDX-License-Identifier: Apache-2.0
"""Masks of a capture of any layout: pixels that are black or transparent do not count.

::

    masks/CAMERA.png          for all frames
    masks/CAMERA/FRAME.png    for one; FRAME is the name of the camera's picture (of the folder where there is one for
                              each frame), of a video the frame's number in it, from 0

They are of the pictures or videos as they are shown, turned where those are, before undistortion. Where a camera has
both, both hold. A mask that cannot be read, of another size or format, or of no camera is a ``CaptureError``, and so
is a folder without a mask of any frame; single masks of no frame are left out with a warning.
Live cameras have no numbered frames, so only masks for all frames count.
"""

import logging
import os
from collections.abc import Callable, Collection, Container, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.calibration import listed
from structgstream.data.camera_files import by_stem, is_hidden, name_of
from structgstream.data.images import PICTURE_SUFFIXES, ImageSource, opencv, read_bytes, reduced_mask
from structgstream.data.source import FrameSource, SourceWrapper, innermost, resized_to
from structgstream.data.timeline import natural
from structgstream.data.undistortion import UndistortedSource, lenses_of
from structgstream.data.video import VideoSource
from structgstream.errors import CaptureError
from structgstream.frames import MultiViewFrame

log = logging.getLogger(__name__)

FOLDER = "masks"
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CameraMasks:
    """The mask files of one camera."""

    size: tuple[int, int]  # width and height of its pictures before undistortion
    always: Path | None  # for all frames, or None
    frames: Mapping[int, Path]  # by frame number, for one


@dataclass(frozen=True)
class MaskedSource(SourceWrapper):
    """The frames of ``source`` with masks, resampled where its pictures are."""

    files: Mapping[str, CameraMasks]
    _always: dict[str, Mask | None] = field(default_factory=dict, init=False, repr=False, compare=False)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        with ThreadPoolExecutor(min(len(self.files), os.cpu_count() or 1) or 1, "masks") as pool:
            for frame in self.source.frames(start):
                names = [name for name in frame.images if name in self.files]
                masks = pool.map(self._mask, names, [frame.index] * len(names))
                counting = {
                    name: mask & frame.masks[name] if name in frame.masks else mask
                    for name, mask in zip(names, masks, strict=True)
                    if mask is not None
                }
                yield replace(frame, masks={**frame.masks, **counting})

    def resized(self, rig: CameraRig) -> "MaskedSource":
        """The same frames at the sizes of ``rig``."""
        return replace(self, source=resized_to(self.source, rig))

    def _mask(self, name: str, index: int) -> Mask | None:
        """The mask of a camera in a frame, at the size of its pictures; None if everything counts."""
        files = self.files[name]
        if name not in self._always:
            self._always[name] = None if files.always is None else self._read(files.always, name)
        always, file = self._always[name], files.frames.get(index)
        own = None if file is None else self._read(file, name)
        return own if always is None else always if own is None else always & own

    def _read(self, file: Path, name: str) -> Mask | None:
        camera = self.rig[name]
        mask = reduced_mask(read_mask(file, size=self.files[name].size, camera=name), (camera.width, camera.height))
        return None if mask.all() else mask


def read_mask(file: Path, *, size: tuple[int, int], camera: str) -> Mask:
    """The mask ``[H, W]`` of a file, of ``size`` (width, height): True where it is neither black nor transparent."""
    cv2, data = opencv(), np.frombuffer(read_bytes(file, what="mask"), np.uint8)
    # As stored: a conversion to 8 bits without alpha would turn small 16-bit values to black, and drop transparency.
    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if picture is None:
        raise CaptureError(f"The mask {file} cannot be decoded ({len(data)} bytes); write it again as PNG.")
    if picture.shape[1::-1] != size:
        raise CaptureError(
            f"The mask {file} has {picture.shape[1]}x{picture.shape[0]} pixels, the pictures of camera {camera!r} have "
            f"{size[0]}x{size[1]}; a mask is of the picture as it is shown, before undistortion."
        )
    channels = picture.reshape(*picture.shape[:2], -1)
    return channels[..., :3].any(axis=2) & channels[..., 3:].all(axis=2)


def masks_folder(path: Path) -> Path:
    """Where the masks of the capture or the videos in ``path`` lie, however the folder is capitalised."""
    entries = sorted(path.iterdir()) if path.is_dir() else []
    found = (entry for entry in entries if entry.is_dir() and entry.name.lower() == FOLDER)
    return next(found, path / FOLDER)


def with_masks(source: FrameSource, folder: Path, *, without: Collection[str] = ()) -> FrameSource:
    """The whole capture ``source``, as its layout is read, with the masks of ``folder``; itself when there are none.

    ``without`` are names of cameras that the source leaves out, whose masks are not used.
    """
    found = sorted(folder.iterdir(), key=lambda entry: natural(entry.name)) if folder.is_dir() else []
    entries = [entry for entry in found if not is_hidden(entry) and name_of(entry) not in without]
    entries = [entry for entry in entries if entry.is_dir() or _is_mask(entry, cameras=source.rig.cameras)]
    if not len(source) and (single := [entry.name for entry in entries if entry.is_dir()]):
        log.warning("%s: the masks of single frames of %s are not used: it is live", source.name, listed(single))
        entries = [entry for entry in entries if not entry.is_dir()]
    if not entries:
        return source
    names = {name_of(entry): entry for entry in entries}
    folders = {name_of(entry): entry for entry in entries if entry.is_dir()}
    if unknown := next((name for name in names if name not in source.rig.cameras), None):
        raise CaptureError(
            f"{names[unknown]} is a mask of camera {unknown!r}, which the capture {source.name} does not have; its "
            f"cameras are {', '.join(source.rig)}. Rename or remove it."
        )

    def masked(stored: FrameSource) -> FrameSource:
        files = {name: _files(folder, name, stored, folders.get(name)) for name in stored.rig if name in names}
        return MaskedSource(stored, files)

    log.warning("%s: what is black in the masks of %s does not count", source.name, listed(names))
    return _below_lenses(source, masked)


def _below_lenses(source: FrameSource, wrap: Callable[[FrameSource], FrameSource]) -> FrameSource:
    """``source`` with the stored pictures, which are undistorted where they have a lens, wrapped."""
    if isinstance(source, UndistortedSource):
        return replace(source, source=wrap(source.source))
    if isinstance(source, SourceWrapper) and lenses_of(source) is not None:
        return replace(source, source=_below_lenses(source.source, wrap))
    return wrap(source)


def _masks(folder: Path) -> list[Path]:
    return [file for file in sorted(folder.iterdir()) if file.is_file() and not is_hidden(file) and _is_mask(file)]


def _is_mask(file: Path, *, cameras: Container[str] = ()) -> bool:
    """Whether a file is a PNG; what else a mask may be, as a video of a camera's name, is refused."""
    suffix = file.suffix.lower()
    if suffix != ".png" and (suffix in PICTURE_SUFFIXES or name_of(file) in cameras):
        raise CaptureError(f"The mask {file} is no PNG; write it as one, because other formats change what is black.")
    return suffix == ".png"


def lasting_mask(folder: Path, name: str) -> Path | None:
    """The mask of a camera in ``folder`` for all frames; None if it has none."""
    return by_stem(_masks(folder)).get(name) if folder.is_dir() else None


def _files(folder: Path, name: str, source: FrameSource, own: Path | None) -> CameraMasks:
    """The mask files of a camera, the first of which is checked; those of single frames lie in ``own``."""
    always, files = lasting_mask(folder, name), {} if own is None else by_stem(_masks(own))
    entries = [] if own is None else [entry for entry in sorted(own.iterdir()) if not is_hidden(entry)]
    numbers = _frame_numbers(source, name) if entries else {}
    expected = f"{next(iter(numbers), '000000')}.png"
    if not isinstance(innermost(source), ImageSource):  # frames of videos have no names
        files = {str(int(stem)) if stem.isdecimal() else stem: file for stem, file in files.items()}
        expected = "000000.png, the frame's number in the video, from 0"
    frames = {numbers[stem]: file for stem, file in files.items() if stem in numbers}
    others = [file for stem, file in files.items() if stem not in numbers]
    if frames and others:
        log.warning("%d masks in %s are of no frame of the capture, such as %s", len(others), own, others[0].name)
    if entries and not frames:
        raise CaptureError(
            f"None of the masks in {own} is of a frame of the capture, such as {entries[0].name}; "
            f"expected names such as {expected}."
        )
    size = (source.rig[name].width, source.rig[name].height)
    for file in filter(None, (always, next(iter(frames.values()), None))):
        read_mask(file, size=size, camera=name)
    return CameraMasks(size, always, frames)


def _frame_numbers(source: FrameSource, name: str) -> dict[str, int]:
    """The frames of a camera by the names of their masks."""
    inner = innermost(source)
    if isinstance(inner, VideoSource):
        own = {stamp: str(number) for number, stamp in enumerate(inner.tracks[name].stamps)}
        return {own[stamp]: index for index, stamp in enumerate(inner.stamps[name]) if stamp is not None}
    if not isinstance(inner, ImageSource):
        return {str(index): index for index in range(len(source))}
    stems = {index: name_of(file) for index, file in enumerate(inner.files[name]) if file is not None}
    if inner.instants and not 1 < len({*stems.values()}) == len(stems):  # a folder for each frame
        return {instant: index for index, instant in enumerate(inner.instants)}
    return {stem: index for index, stem in stems.items()}
