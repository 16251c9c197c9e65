# SPDX-License-Identifier: Apache-2.0
"""Where the files of each camera lie in a folder, with or without a calibration.

::

    CAMERA.mp4               one video per camera
    CAMERA/anything.mp4      a folder per camera with its one video, as cards are copied (CAMERA/DCIM/100GOPRO/...)
    CAMERA/FRAME.jpg         a folder of pictures per camera (CAMERA/data/FRAME.png of EuRoC, CAMERA/images/FRAME.png)
    FRAME/CAMERA.jpg         a folder of pictures per frame (frame000000/images/CAMERA.png of 3DGStream)
    CAMERA.jpg               one picture per camera

in the folder itself, in one of a name of :data:`ROOTS` in it, or in the only one, up to two levels below, that holds
several videos or several folders of pictures. Two files of one name, a link to a file that is not there, or several
takes are a ``CaptureError``.
"""

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from unicodedata import normalize

from structgstream.data.images import PICTURE_SUFFIXES
from structgstream.data.timeline import natural
from structgstream.data.video_index import VIDEO_SUFFIXES
from structgstream.errors import CaptureError

REPORT = "report"
"""The folder that the check of a capture leaves in it, whose pictures are no camera's."""
SYSTEM = frozenset({"__MACOSX", "@eaDir", "#recycle", "$RECYCLE.BIN", "System Volume Information", "lost+found"})
"""Folders that file servers, archives and systems leave, with pictures of their own."""


def is_hidden(path: Path) -> bool:
    """Whether a file is hidden or of the system: macOS leaves a ``._NAME`` for each NAME on file systems of cards."""
    return path.name.startswith(".") or path.name in SYSTEM


def name_of(path: Path) -> str:
    """The name of a folder, or of a file without its suffix, as a camera's: letters with marks composed, as in texts.

    File systems of macOS take them apart.
    """
    return normalize("NFC", path.name if path.is_dir() else path.stem)


def files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """The files of these kinds (lower-case suffixes, with the dot) in a folder, sorted by name, without hidden ones."""
    named = (file for file in folder.iterdir() if file.suffix.lower() in suffixes and not is_hidden(file))
    found = sorted(file for file in named if not file.is_dir())
    for file in found:
        check_link(file)
    return found


def check_link(file: Path) -> None:
    """Refuses a link to a file that is not there."""
    if file.is_symlink() and not file.exists():
        raise CaptureError(
            f"{file} is a link to {file.readlink()}, which does not exist; restore that file, or move the link out of "
            "the folder."
        )


def by_stem(files: Iterable[Path]) -> dict[str, Path]:
    """Files by their names without suffix."""
    found: dict[str, Path] = {}
    for file in files:
        if (name := name_of(file)) in found:
            raise CaptureError(
                f"{found[name].name} and {file.name} in {file.parent} are of one name, {name!r}; expected one file of "
                "each: move the other out of the folder."
            )
        found[name] = file
    return found


REDUCED = ("images_2", "images_4", "images_8")
ROOTS = ("frames", "images", "image", "videos", "hdvideos", "hdimgs", "synchronized_videos", "", *REDUCED)
"""In the order in which they are looked through, in lower case; hdVideos and hdImgs are the CMU Panoptic toolbox's, the
synchronized ones FreeMoCap's."""
NO_TAKES = ("masks", "mask", "board", "recordings", "calibration", "annotated_videos", "work", REPORT)
NO_CAMERAS = (*ROOTS, *NO_TAKES)
"""Folders that are no camera's and no frame's: of ``masks.py``, of the check, and of the tools that calibrate."""
UNREAD = frozenset({
    ".3fr", ".arw", ".bag", ".braw", ".cr2", ".cr3", ".dng", ".exr", ".gif", ".hdr", ".insv", ".jxl", ".m4s", ".mcap",
    ".nef", ".orf", ".r3d", ".raf", ".raw", ".rw2", ".svo", ".svo2", ".tga",
})  # fmt: skip
"""What cameras write that is not read here."""
INSIDE = ("images", "data", "DCIM")
"""What lies between the folder of a camera or a frame and its files."""
RECORDINGS = "recordings"
"""Where caliscope has a folder for each take."""


def roots_of(path: Path) -> list[Path]:
    """The folders of :data:`ROOTS` that are there, ``path`` among them, in that order, however they are capitalised."""
    found = {entry.name.lower(): entry for entry in sorted(path.iterdir()) if entry.is_dir()} | {"": path}
    return [found[name] for name in ROOTS if name in found]


def folders_of(root: Path, *, without: Collection[str] = NO_CAMERAS) -> list[Path]:
    """The folders in ``root`` that may be of cameras or frames, in natural order of their names."""
    if not root.is_dir():
        return []
    found = (entry for entry in root.iterdir() if not is_hidden(entry) and entry.name.lower() not in without)
    return sorted((entry for entry in found if entry.is_dir()), key=lambda entry: natural(entry.name))


def filmed_folder(folder: Path, suffixes: Collection[str]) -> Path | None:
    """The folder with files of these kinds: ``folder``, or that within it of a name of :data:`INSIDE` or of a card."""
    if files_of(folder, suffixes):
        return folder
    inner = [folder / name for name in INSIDE if (folder / name).is_dir()]
    if folder.name == "DCIM":
        inner = [entry for entry in sorted(folder.iterdir()) if entry.is_dir() and not is_hidden(entry)]
    return next((found for entry in inner if (found := filmed_folder(entry, suffixes)) is not None), None)


def videos_in(root: Path) -> dict[str, Path]:
    """The video of each camera by its name: ``CAMERA.mp4``, else ``CAMERA/anything.mp4``; empty without any."""
    if not root.is_dir():
        return {}
    if found := by_stem(files_of(root, VIDEO_SUFFIXES)):
        return found
    filmed = {name_of(folder): filmed_folder(folder, VIDEO_SUFFIXES) for folder in folders_of(root)}
    files = {name: files_of(folder, VIDEO_SUFFIXES) for name, folder in filmed.items() if folder is not None}
    if any(len(own) > 1 for own in files.values()):
        return {}
    return {name: own[0] for name, own in files.items()}


def pictures_in(root: Path) -> dict[str, dict[str, Path]]:
    """The pictures of each folder of ``root``, of a camera or of a frame, by their names without suffix."""
    filmed = {name_of(folder): filmed_folder(folder, PICTURE_SUFFIXES) for folder in folders_of(root)}
    return {name: by_stem(files_of(own, PICTURE_SUFFIXES)) for name, own in filmed.items() if own is not None}


def has_files(folder: Path) -> bool:
    """Whether a folder has videos of cameras, or folders of pictures."""
    return bool(videos_in(folder) or pictures_in(folder))


def has_frames(path: Path) -> bool:
    """Whether the folder itself or one of :data:`ROOTS` in it has."""
    return any(map(has_files, roots_of(path)))


def other_roots(where: Path, *, pictures: bool = False) -> Iterator[Path]:
    """Folders of videos, or of folders of pictures, up to two below ``where`` and of other names: takes."""
    below = folders_of(where) + folders_of(where / RECORDINGS)
    below += [inner for folder in folders_of(where, without=NO_TAKES) for inner in folders_of(folder, without=NO_TAKES)]
    found = {folder: pictures_in(folder) if pictures else files_of(folder, VIDEO_SUFFIXES) for folder in below}
    takes = [folder for folder, own in found.items() if len(own) > 1]
    if len(takes) > 1:
        names = ", ".join(str(take.relative_to(where)) for take in takes[:4])
        what, each = ("pictures", "folder") if pictures else ("videos", "video")
        raise CaptureError(
            f"{where} has {what} in several folders ({names}); expected those of one take, a {each} per camera. Give "
            "the folder of one take; if these are cameras, join the chapters of each to one file."
        )
    yield from takes


def unread_files(where: Path) -> str:
    """What cameras wrote in ``where``, or up to three folders below, that is not read here, for messages."""
    inside = (sorted(where.glob("*/" * depth + "*")) for depth in range(4))
    files = (file for level in inside for file in level if file.suffix.lower() in UNREAD)
    if (file := next(files, None)) is None:
        return ""
    if file.suffix.lower() == ".m4s":
        return (
            f"; {file.relative_to(where)} is a piece of a video: join the pieces of each camera, after that with the "
            "header (init.mp4), to one .mp4"
        )
    return (
        f"; {file.relative_to(where)} is of a kind that is not read: convert pictures to PNG or JPEG, videos to H.264 "
        "or HEVC in mp4, keeping the time of each frame"
    )
