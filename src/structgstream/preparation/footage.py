# SPDX-License-Identifier: Apache-2.0
"""The files of each camera as they were found: one video a camera, or one folder of pictures; and pictures of them.

::

    VIDEOS/CAMERA.mp4             one video per camera, in the folder or in videos/ below it
    VIDEOS/CAMERA/anything.mp4    a folder per camera with its one video, as cards are copied
    VIDEOS/CAMERA/FRAME.jpg       a folder of pictures per camera, in the folder or in images/ below it
    VIDEOS/CAMERA.jpg             one picture per camera

A missing folder, two files of one camera and a file that cannot be read are a ``CaptureError``.
"""

import logging
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import atomic_write
from structgstream.data.camera_files import (
    NO_CAMERAS,
    UNREAD,
    check_link,
    files_of,
    filmed_folder,
    is_hidden,
    name_of,
    other_roots,
)
from structgstream.data.images import (
    PICTURE_SUFFIXES,
    check_one_series,
    opencv,
    picture_size,
    read_picture,
    reduced_picture,
    significant_bits,
)
from structgstream.data.posed_capture import PICTURE_FPS, filmed_roots
from structgstream.data.prepared import ROVING, pictures_of
from structgstream.data.sound import read_audio
from structgstream.data.timeline import Clock, natural, picture_slots
from structgstream.data.video import measured_fps, pictures_at
from structgstream.data.video_index import VIDEO_SUFFIXES, VideoTrack, open_video, scan_videos, video_stream
from structgstream.errors import CaptureError
from structgstream.geometry import Indices

_log = logging.getLogger(__name__)

WORTH_SEEKING = 60  # frames; closer ones are decoded in one pass
FILMED = VIDEO_SUFFIXES | PICTURE_SUFFIXES | UNREAD
"""What a camera may have written, also in ways that are not read here."""
CHAPTER = re.compile(r"(G[HLPSX]\d\d|GOPR)", re.IGNORECASE)  # of a GoPro, GX010001 and GX020001
LAYOUTS = "CAMERA.mp4, CAMERA/anything.mp4, CAMERA/FRAME.jpg or CAMERA.jpg"


class NoFootage(CaptureError):
    """A folder without a video or a picture."""


@dataclass(frozen=True)
class Footage:
    """What the cameras filmed."""

    where: Path  # the folder it lies in, for messages
    files: Mapping[str, Path]
    """Name of a camera to its video, folder of pictures or picture, in natural order of the names."""
    tracks: Mapping[str, VideoTrack]  # of the cameras with videos
    stills: Mapping[str, tuple[Path, ...]]  # of the cameras with pictures, these in order
    picture_fps: float = PICTURE_FPS  # frames a second of pictures

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self.files)

    @property
    def fps(self) -> float:
        """Frames a second by time stamp; of pictures, what was stated."""
        return (measured_fps(self.tracks) if self.tracks else None) or self.picture_fps

    def size(self, name: str) -> tuple[int, int]:
        """Width and height of a camera's pictures, pixels."""
        if (track := self.tracks.get(name)) is not None:
            return track.width, track.height
        return picture_size(self.stills[name][0])

    def stamps(self, name: str) -> NDArray[np.float64]:
        """Time ``[N]`` of every frame by the camera's own clock, seconds, ascending."""
        if (track := self.tracks.get(name)) is not None:
            return track.seconds
        return self._slots[name] / self.picture_fps

    @cached_property
    def _bits(self) -> int:
        return significant_bits(self.stills)

    @cached_property
    def _slots(self) -> Mapping[str, Indices]:
        """Which instant each picture is of, from 0 on."""
        return picture_slots(self.stills)

    def pictures(self, name: str, indices: Sequence[int] | Indices) -> Iterator[NDArray[np.uint8]]:
        """Pictures ``[H, W, 3]`` sRGB of frames of one camera, whose numbers ascend, at their stored size."""
        if (track := self.tracks.get(name)) is not None:
            for run in _runs([int(index) for index in indices]):
                yield from self._decoded(name, track, run)
        else:
            size = self.size(name)
            for file in (self.stills[name][index] for index in indices):
                picture = read_picture(file, bits=self._bits)
                if picture.shape[1::-1] != size:
                    raise CaptureError(
                        f"The picture {file} has {picture.shape[1]}x{picture.shape[0]} pixels, the first one of camera "
                        f"{name!r} {size[0]}x{size[1]}; expected one size: export them again in one mode, or move the "
                        "others out of the folder."
                    )
                yield picture

    def _decoded(self, name: str, track: VideoTrack, indices: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        def refuse(lost: int, following: int | None, reason: str) -> None:
            raise CaptureError(
                f"The video {track.path} of camera {name!r} cannot be decoded at {lost * track.tick_seconds:.3f} s "
                f"({reason}): truncated or damaged; copy or record it again, or go on without it."
            )

        stamps = [track.stamps[index] for index in indices]
        with closing(pictures_at(track, stamps, size=(track.width, track.height), on_damage=refuse)) as pictures:
            for shown in pictures:
                assert shown is not None, "a lost picture raises"
                yield shown[0]

    def audio(self, name: str) -> NDArray[np.float32] | None:
        """Mono samples ``[N]`` at ``SAMPLE_RATE``; sample 0 is at time 0 of the stamps. None without sound."""
        return read_audio(self.files[name]) if name in self.tracks else None

    def metadata(self, name: str) -> dict[str, str]:
        """What a camera's file states as text, by lower-case key; nothing for pictures."""
        if name not in self.tracks:
            return {}
        with open_video(self.files[name]) as container:
            stated = {**video_stream(container).metadata, **container.metadata}
        return {key.lower(): value for key, value in stated.items()}

    def only(self, names: Collection[str]) -> "Footage":
        """These cameras alone."""
        return Footage(
            self.where,
            {name: file for name, file in self.files.items() if name in names},
            {name: track for name, track in self.tracks.items() if name in names},
            {name: still for name, still in self.stills.items() if name in names},
            self.picture_fps,
        )


def find_footage(where: Path, *, picture_fps: float | None = None) -> Footage:
    """The cameras of a folder in one of the layouts of this module; pictures are ``picture_fps`` a second."""
    if not where.is_dir():
        kind = "a file" if where.exists() else "missing"
        raise CaptureError(f"{where} is {kind}; give the folder that holds the cameras' videos ({LAYOUTS}).")
    found = {root: _found(root) for root in dict.fromkeys(filmed_roots(where)) if root.is_dir()}
    # A stray picture or preview next to the folder of the videos is no take: two cameras come before one.
    root = next((root for count in (2, 1) for root, files in found.items() if len(files) >= count), None)
    if root is None or len(found[root]) < 2:
        root = next(other_roots(where), None) or next(other_roots(where, pictures=True), root)
    if root is not None:
        files = found.get(root) or _found(root)
        if root != where:
            _log.info("The cameras are those of %s", root)
        for stray in found[where] if root != where else ():
            _log.warning("%s is left out: the cameras are those of %s", found[where][stray], root)
        _check_left(root, files)
        ordered = {name: files[name] for name in sorted(files, key=natural)}
        return _footage(where, ordered, PICTURE_FPS if picture_fps is None else picture_fps)
    contents = ", ".join(sorted(entry.name for entry in where.iterdir())[:6])
    found = f"holds no videos and no pictures, but {contents}" if contents else "is empty"
    raise NoFootage(f"{where} {found}; expected {LAYOUTS}.")


def _runs(indices: Sequence[int]) -> list[list[int]]:
    """Ascending numbers of frames, split where it is faster to seek."""
    runs: list[list[int]] = []
    for index in indices:
        if runs and index - runs[-1][-1] <= WORTH_SEEKING:
            runs[-1].append(index)
        else:
            runs.append([index])
    return runs


def _footage(where: Path, files: Mapping[str, Path], picture_fps: float) -> Footage:
    videos = {name: file for name, file in files.items() if file.suffix.lower() in VIDEO_SUFFIXES}
    stills = {
        name: pictures_of(file) if file.is_dir() else (file,) for name, file in files.items() if name not in videos
    }
    for name, own in stills.items():
        check_one_series(name, own)
    if videos and stills:
        video, still = next(iter(videos)), next(iter(stills))
        raise CaptureError(
            f"{where} has a video of camera {video!r} and pictures of camera {still!r}; expected one kind of all "
            "cameras: move the others out of the folder."
        )
    return Footage(where, files, scan_videos(videos) if videos else {}, stills, picture_fps)


def _found(root: Path) -> dict[str, Path]:
    """Files or folders of the cameras of ``root`` by name; nothing when there are none."""
    entries = sorted(entry for entry in root.iterdir() if not is_hidden(entry))
    for entry in entries:
        if entry.suffix.lower() in VIDEO_SUFFIXES | PICTURE_SUFFIXES:
            check_link(entry)
    for suffixes in (VIDEO_SUFFIXES, PICTURE_SUFFIXES):
        found: dict[str, Path] = {}
        several: list[tuple[Path, list[Path]]] = []
        for entry in entries:
            file = entry if entry.is_file() and entry.suffix.lower() in suffixes else None
            if entry.is_dir() and entry.name.lower() not in NO_CAMERAS:
                file = filmed_folder(entry, suffixes)
                if file is not None and suffixes is VIDEO_SUFFIXES:
                    files = files_of(file, suffixes)
                    file = files[0]
                    if len(files) > 1:
                        several.append((entry, files))
                        continue
            if file is None:
                continue
            name = name_of(entry)
            if name in found:
                raise CaptureError(
                    f"{found[name].name} and {file.name} in {root} are both of camera {name!r}; expected one file per "
                    "camera: join them or move one out of the folder."
                )
            found[name] = file
        for folder, files in several:
            if {file.resolve() for file in files} <= {file.resolve() for file in found.values()}:
                continue  # what the links in root lead to
            if found or all(CHAPTER.match(file.stem) for file in files):
                raise CaptureError(
                    f"The folder {folder} of camera {folder.name!r} holds {len(files)} videos ({files[0].name}, "
                    f"{files[1].name}, ...); expected one per camera: join the chapters of the take to one file, "
                    "or move the folder away if it is no camera's."
                )
        if found:
            return found
    return {}


def _check_left(root: Path, found: Mapping[str, Path]) -> None:
    """Warns of files and folders that are no camera, so that none is lost unnoticed."""
    taken = next(iter(found.values()))
    for entry in sorted(entry for entry in root.iterdir() if not is_hidden(entry)):
        if entry.is_file() and entry.suffix.lower() in FILMED and entry not in found.values():
            _log.warning(
                "The file %s is left out: it is not of the kind of %s. If it is a camera's, convert it, keeping the "
                "time of each frame.",
                entry, taken,
            )  # fmt: skip
        if not entry.is_dir() or entry.name.lower() in NO_CAMERAS or found.get(entry.name, root).is_relative_to(entry):
            continue
        if not any(entry.iterdir()):
            raise CaptureError(
                f"The folder {entry} is empty; copy what camera {entry.name!r} filmed into it, or remove it if it is "
                "no camera."
            )
        _log.warning(
            "The folder %s is left out: it holds no %s, as %s does. If it is a camera, give all of one kind.",
            entry, "video" if taken.suffix.lower() in VIDEO_SUFFIXES else "picture", taken,
        )  # fmt: skip


Picture = NDArray[np.uint8]
STILL_PICTURES = 9


@dataclass(frozen=True)
class Shots(Sequence[Picture]):
    """Pictures of one camera, decoded on access, so that a long take does not fill the memory."""

    footage: Footage
    camera: str
    indices: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, number: int) -> Picture:  # pyright: ignore[reportIncompatibleMethodOverride]  (no slices)
        return next(self.footage.pictures(self.camera, [self.indices[number]]))


def shared_seconds(footage: Footage, clocks: Mapping[str, Clock]) -> tuple[float, float]:
    """First and last moment that all cameras filmed, in the time that they share; without one a
    ``CaptureError``."""
    spans = {}
    for name in footage.cameras:
        first, last = clocks.get(name, Clock()).common_seconds(footage.stamps(name)[[0, -1]])
        spans[name] = first, last
    late = max(spans, key=lambda name: spans[name][0])
    early = min(spans, key=lambda name: spans[name][1])
    first, last = spans[late][0], spans[early][1]
    if first > last + 1e-6:
        lengths = [f"{spans[name][1] - spans[name][0]:.3f} s" for name in (early, late)]
        raise CaptureError(
            f"The cameras of {footage.where} have no moment in common: {footage.files[early].name} of camera {early!r} "
            f"ends {first - last:.3f} s before {footage.files[late].name} of camera {late!r} begins (lengths "
            f"{lengths[0]} and {lengths[1]}); give longer videos, or leave one camera out with --without."
        )
    return first, last


def shots_of(footage: Footage, clocks: Mapping[str, Clock], seconds: Sequence[float]) -> dict[str, Shots]:
    """Each camera's pictures nearest to these moments of the shared time."""
    found = {}
    for name in footage.cameras:
        times = clocks.get(name, Clock()).common_seconds(footage.stamps(name))
        indices = [int(np.abs(times - moment).argmin()) for moment in seconds]
        found[name] = Shots(footage, name, tuple(indices))
    return found


def still_pictures(footage: Footage) -> dict[str, list[Picture]]:
    """One picture of each camera without what moves: each value is the median over pictures spread over its take.

    It does not belong to one moment, so it needs no clocks; what stands still for more than half of the take remains.
    """
    found = {}
    for name in footage.cameras:
        taken = len(footage.stamps(name))
        count = min(STILL_PICTURES, taken - 1 + taken % 2)  # an odd one, whose median is a value that was filmed
        indices = np.unique(np.linspace(0, taken - 1, count).round().astype(int))
        stacked = np.stack(list(footage.pictures(name, indices.tolist())))
        stacked.partition(count // 2, axis=0)
        found[name] = [stacked[count // 2].copy()]
    return found


def spread_moments(first: float, last: float, count: int) -> list[float]:
    """Moments from the first to the last, both included; fewer when the take has no length."""
    return np.linspace(first, last, count).tolist() if last > first and count > 1 else [first]


ROVING_FRAMES = 40  # most that are used of a camera that was walked through the set
CANDIDATES = 5  # of which each one is the sharpest
MIN_FRAMES, MIN_SECONDS = 8, 4.0
SHARPNESS_SIDE = 640  # pixels, to which the longer side is reduced before sharpness is measured
OR_PICTURES = "or a folder of pictures of one camera"


def open_roving(path: Path) -> Footage:
    """The one camera of a video, or of a folder of its pictures, that was walked through the set: any phone, whose
    exposure, lens and time are its own.

    Raises:
        CaptureError: it is missing, cannot be read, or is too short.
    """
    if not path.exists():
        raise CaptureError(f"The roving video {path} does not exist; give a video, {OR_PICTURES}.")
    files = {ROVING: path}
    if path.is_dir():
        footage = Footage(path.parent, files, {}, {ROVING: pictures_of(path)})
        if not footage.stills[ROVING]:
            raise CaptureError(f"The folder {path} holds no pictures; give a video, {OR_PICTURES}.")
    elif path.suffix.lower() in VIDEO_SUFFIXES:
        footage = Footage(path.parent, files, scan_videos(files), {})
    else:
        raise CaptureError(f"{path} is no video; give one, {OR_PICTURES}.")
    stamps = footage.stamps(ROVING)
    seconds = float(np.ptp(stamps)) if footage.tracks and len(stamps) else MIN_SECONDS
    if len(stamps) < MIN_FRAMES or seconds < MIN_SECONDS:
        length = f"{len(stamps)} frames" + (f" of {seconds:.1f} s" if footage.tracks else "")
        raise CaptureError(
            f"The roving video {path} is too short ({length}); walk through the set for half a minute, at least "
            f"{MIN_FRAMES} frames and {MIN_SECONDS:g} s."
        )
    return footage


def sharpest_frames(footage: Footage) -> Mapping[str, Picture]:
    """The frames ``[H, W, 3]`` of a roving camera that are used, the sharpest of each of equal parts, by name in their
    order."""
    count = len(footage.stamps(ROVING))
    tried = np.unique(np.linspace(0, count - 1, min(count, ROVING_FRAMES * CANDIDATES)).round().astype(int))
    part = np.arange(len(tried)) * min(ROVING_FRAMES, len(tried)) // len(tried)
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
    for number, picture in zip(numbers, footage.pictures(ROVING, numbers), strict=True):
        yield f"{ROVING}/{number:06d}", picture


def write_png(path: Path, picture: Picture) -> None:
    """Writes ``picture`` ``[H, W, 3]``, whole or not at all. Raises StorageError if it cannot be written."""
    cv2 = opencv()
    stored = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
    atomic_write(path, bytes(stored), called="The picture", new_folder=True, sync=False)
