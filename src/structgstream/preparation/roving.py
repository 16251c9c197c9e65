# SPDX-License-Identifier: Apache-2.0
"""Frames of a camera that was walked through the set: the sharpest of each of equal parts of its video.

The camera is any phone. Its exposure, its lens and the time are its own; a rolling shutter is ignored.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from structgstream.atomic_files import atomic_write
from structgstream.data.images import opencv, reduced_picture
from structgstream.data.prepared import ROVING, pictures_of
from structgstream.data.video_index import VIDEO_SUFFIXES, scan_videos
from structgstream.errors import CaptureError
from structgstream.preparation.footage import Footage, Picture

FRAMES = 40  # most that are used
CANDIDATES = 5  # of which each one is the sharpest
MIN_FRAMES, MIN_SECONDS = 8, 4.0
SHARPNESS_SIDE = 640  # pixels, to which the longer side is reduced before sharpness is measured


def open_roving(path: Path) -> Footage:
    """The one camera of a video, or of a folder of its pictures.

    Raises:
        CaptureError: it is missing, cannot be read, or is too short.
    """
    if not path.exists():
        raise CaptureError(
            f"The roving video {path} does not exist; give a video, or a folder of pictures of one camera."
        )
    files = {ROVING: path}
    if path.is_dir():
        footage = Footage(path.parent, files, {}, {ROVING: pictures_of(path)})
        if not footage.stills[ROVING]:
            raise CaptureError(
                f"The folder {path} holds no pictures; give a video, or a folder of pictures of one camera."
            )
    elif path.suffix.lower() in VIDEO_SUFFIXES:
        footage = Footage(path.parent, files, scan_videos(files), {})
    else:
        raise CaptureError(f"{path} is no video; give one, or a folder of pictures of one camera.")
    count = len(footage.tracks[ROVING].stamps) if footage.tracks else len(footage.stills[ROVING])
    seconds = float(np.ptp(footage.stamps(ROVING))) if footage.tracks and count else MIN_SECONDS
    if count < MIN_FRAMES or seconds < MIN_SECONDS:
        length = f"{count} frames" + (f" of {seconds:.1f} s" if footage.tracks else "")
        raise CaptureError(
            f"The roving video {path} is too short ({length}); walk through the set for half a minute, at least "
            f"{MIN_FRAMES} frames and {MIN_SECONDS:g} s."
        )
    return footage


def sharpest_frames(footage: Footage) -> Mapping[str, Picture]:
    """The frames ``[H, W, 3]`` that are used, by name, in their order."""
    count = len(footage.stamps(ROVING))
    tried = np.unique(np.linspace(0, count - 1, min(count, FRAMES * CANDIDATES)).round().astype(int))
    part = np.arange(len(tried)) * min(FRAMES, len(tried)) // len(tried)
    best: dict[int, tuple[float, int, Picture]] = {}
    for own, number, picture in zip(part.tolist(), tried.tolist(), footage.pictures(ROVING, tried), strict=True):
        sharp = sharpness(picture)
        if own not in best or sharp > best[own][0]:
            best[own] = sharp, number, picture
    return {f"{ROVING}/{number:06d}": picture for _, number, picture in best.values()}


def sharpness(picture: Picture) -> float:
    """Variance of the Laplacian of the picture ``[H, W, 3]`` in grey: larger where edges are sharper."""
    cv2 = opencv()
    grey = cv2.cvtColor(reduced_picture(picture, SHARPNESS_SIDE), cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def frames_named(footage: Footage, names: Mapping[str, object]) -> Iterator[tuple[str, Picture]]:
    """The frames of these names with their names, read again one by one."""
    numbers = sorted(int(name.removeprefix(f"{ROVING}/")) for name in names)
    found = footage.pictures(ROVING, numbers)
    yield from ((f"{ROVING}/{number:06d}", picture) for number, picture in zip(numbers, found, strict=True))


def write_png(path: Path, picture: Picture) -> None:
    """Writes ``picture`` ``[H, W, 3]``, whole or not at all. Raises StorageError if it cannot be written."""
    cv2 = opencv()
    stored = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
    atomic_write(path, bytes(stored), called="The picture", new_folder=True, sync=False)
