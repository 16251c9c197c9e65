# SPDX-License-Identifier: Apache-2.0
"""Captures whose frames are picture files, one list of files per camera; what the header of a picture states (Exif).

A file that cannot be read or decoded, or is no picture, is a ``CaptureError``.
"""

import io
import logging
import math
import os
import re
import struct
import warnings
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import islice, repeat
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.timeline import common_slots, instants_of, natural
from structgstream.errors import CalibrationError, CaptureError, MissingExtraError, import_extra
from structgstream.frames import MultiViewFrame

if TYPE_CHECKING:
    from PIL.ImageCms import ImageCmsTransform
    from PIL.ImageFile import ImageFile

PICTURE_SUFFIXES = frozenset({
    ".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".heic", ".heif", ".avif", ".jfif",
    ".jpe", ".jp2", ".pgm", ".ppm",
})  # fmt: skip
HEIF_BRANDS = frozenset({b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis"})
ORIENTATION = 0x0112  # the tag, in EXIF as in TIFF
TIFF_SIZE = (0x0100, 0x0101)  # the tags of width and height
OPAQUE = 0.98
"""Share of opacity from which on a pixel counts."""
SAME_COLORS = 3
"""Levels of 255 by which a profile may change a colour and be sRGB all the same."""

log = logging.getLogger(__name__)

Pixel = TypeVar("Pixel", np.uint8, np.bool_)


@dataclass(frozen=True)
class ImageSource:
    """A :class:`~structgstream.data.source.FrameSource` over picture files."""

    name: str  # the capture's name
    rig: CameraRig  # its cameras, at the size of the pictures
    fps: float  # frames a second
    files: Mapping[str, tuple[Path | None, ...]]  # camera name to its picture in each frame; None where it has none
    points: NDArray[np.float64] | None = None  # ``[P, 3]`` points that came with the capture, or None
    instants: tuple[str, ...] = ()  # name of each frame in the files; empty if frames have no names
    apart_seconds: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Camera name to how long after its instant its picture of each frame was taken, ``[N]``; empty where that is not
    known."""
    turns: Mapping[str, int] = field(default_factory=dict)
    """Camera name to the EXIF orientation, 1 to 8, by which its pictures are turned; 1 where it is missing."""

    def __len__(self) -> int:
        return min(len(files) for files in self.files.values())

    @cached_property
    def _bits(self) -> int:
        return significant_bits(self.files)

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """The frames from stream index ``start``; the pictures of one instant are read in parallel."""
        opencv()  # missing, it is reported once
        bits = self._bits
        with ThreadPoolExecutor(min(len(self.rig), os.cpu_count() or 1), "pictures") as pool:
            for index in range(start, len(self)):
                paths = {name: path for name in self.rig if (path := self.files[name][index]) is not None}
                pictures = dict(zip(paths, pool.map(self._read, paths, paths.values(), repeat(bits)), strict=True))
                masks = {name: mask for name, (_, mask) in pictures.items() if mask is not None}
                images = {name: picture for name, (picture, _) in pictures.items()}
                yield MultiViewFrame(index, index / self.fps, images, masks=masks)

    def _read(self, name: str, path: Path, bits: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
        """A picture of a camera and where it is opaque, turned, checked against the size of the camera."""
        picture, mask = read_picture_and_mask(path, bits=bits)
        turn, camera = self.turns.get(name, 1), self.rig[name]
        picture, mask = turned(picture, turn), None if mask is None else turned(mask, turn)
        height, width = picture.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise CalibrationError(
                f"The picture {path} has {width}x{height} pixels, its camera's intrinsics are for "
                f"{camera.width}x{camera.height}; scale the intrinsics, or use the pictures that were calibrated."
            )
        return picture, mask


def opencv() -> ModuleType:
    """The module ``cv2``, from the extra ``capture``."""
    return import_extra("cv2", "capture")


def common_pictures(
    files: Mapping[str, Mapping[str, Path]], *, where: Path, training: Collection[str]
) -> tuple[dict[str, tuple[Path | None, ...]], tuple[str, ...]]:
    """The pictures of the time steps of a capture, of which cameras may lack some: by camera that of each step, None
    where it has none; and the names of the steps.

    Args:
        files: camera name to its pictures, by the name of the instant.
        training: names of the cameras that are not held out.

    Raises:
        CaptureError: see :func:`~structgstream.data.timeline.common_slots`; or a camera shares no instant with another.
    """
    keys = instants_of({camera: list(pictures) for camera, pictures in files.items()})
    taken = Counter(key for own in keys.values() for key in own.values())
    alone = [camera for camera, own in keys.items() if own and all(taken[key] == 1 for key in own.values())]
    if len(keys) > 1 and alone:
        other = next(camera for camera in keys if camera != alone[0])
        raise CaptureError(
            f"The pictures of cameras {alone[0]!r} ({next(iter(keys[alone[0]]))}, ...) and {other!r} "
            f"({next(iter(keys[other]), 'none')}, ...) of {where} have no names and no numbers in common, so it is not "
            "known which are of one instant; name those of one instant alike (000000.png)."
        )
    named = {keys[camera][instant]: instant for camera, pictures in files.items() for instant in pictures}
    files = {
        camera: {named[keys[camera][instant]]: file for instant, file in pictures.items()}
        for camera, pictures in files.items()
    }
    instants = sorted({*named.values()}, key=natural)
    slots = {
        camera: [slot for slot, instant in enumerate(instants) if instant in pictures]
        for camera, pictures in files.items()
    }
    common = common_slots(slots, where=str(where), label=lambda slot: f"frame {instants[slot]!r}", training=training)
    shown = tuple(instants[slot] for slot in common)
    return {camera: tuple(map(pictures.get, shown)) for camera, pictures in files.items()}, shown


def read_picture(path: Path, *, bits: int = 16) -> NDArray[np.uint8]:
    """The picture of :func:`read_picture_and_mask`."""
    return read_picture_and_mask(path, bits=bits)[0]


def read_picture_and_mask(path: Path, *, bits: int = 16) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """One picture as ``[H, W, 3]`` sRGB, as its pixels are stored, and where it is opaque, ``[H, W]``; None where it is
    everywhere.

    Args:
        bits: how many bits the values of 16-bit files use (:func:`significant_bits`).
    """
    cv2 = opencv()
    stored = stored_picture(path)
    mask = None
    if stored.ndim == 3 and stored.shape[2] == 4:
        alpha, most = stored[..., 3], int(np.iinfo(stored.dtype).max)
        if stored.dtype == np.uint16 and not alpha.max() >> bits:
            most = (1 << bits) - 1
        opaque = alpha >= OPAQUE * most
        mask = None if opaque.all() else opaque
        stored = np.ascontiguousarray(stored[..., :3])
    if stored.dtype == np.uint16:
        if bits < 16 and stored.max() >> bits:
            raise CaptureError(
                f"The picture {path} has values up to {stored.max()}, others of its capture are of {bits} bits; "
                "expected one depth: export all pictures again with 8 or 16 bits."
            )
        stored = (stored >> (bits - 8)).astype(np.uint8)
    picture = cv2.cvtColor(stored, cv2.COLOR_GRAY2RGB if stored.ndim == 2 else cv2.COLOR_BGR2RGB)
    with _opened(path) as header:
        profile = None if header is None else header.info.get("icc_profile")
    return _in_srgb(picture, profile), mask


def _in_srgb(picture: NDArray[np.uint8], profile: bytes | None) -> NDArray[np.uint8]:
    """A picture ``[H, W, 3]`` whose values are colours of an ICC profile (Display P3, Adobe RGB), in sRGB."""
    from PIL import Image, ImageCms

    transform = _to_srgb(profile) if profile else None
    return picture if transform is None else np.array(ImageCms.applyTransform(Image.fromarray(picture), transform))


@cache
def _to_srgb(profile: bytes) -> "ImageCmsTransform | None":
    """From an ICC profile; None for sRGB, in its many spellings, and for profiles that are damaged or not of RGB."""
    from PIL import Image, ImageCms

    if profile[16:20] != b"RGB ":
        return None
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), "RGB", "RGB")
    except (ImageCms.PyCMSError, OSError):
        return None
    levels = np.arange(0, 256, 15).astype(np.uint8)
    cube = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(len(levels), -1, 3)
    change = np.abs(np.array(ImageCms.applyTransform(Image.fromarray(cube), transform)).astype(np.int16) - cube)
    return transform if change.max() > SAME_COLORS else None


def significant_bits(files: Mapping[str, Sequence[Path | None]]) -> int:
    """Of how many bits the values of pictures of 16 bits are: 10, 12, 14 or 16, one number for a capture.

    Machine vision cameras store 10 to 14 bits in 16. The first, middle and last picture of each camera decide, so that
    it does not depend on where reading starts.
    """
    most, first = 0, None
    for own in files.values():
        present = [file for file in own if file is not None]
        first = first or next(iter(present), None)
        for file in dict.fromkeys((present[0], present[len(present) // 2], present[-1]) if present else ()):
            if not _may_be_deep(file) or (stored := stored_picture(file)).dtype != np.uint16:
                break
            most = max(most, int((stored[..., :3] if stored.ndim == 3 else stored).max()))
    bits = next(bits for bits in (10, 12, 14, 16) if not most >> bits) if most else 16
    if bits < 16:
        text = "The pictures of 16 bits, such as %s, have values up to %d: they are read as %d bits"
        log.warning(text, first, most, bits)
    return bits


def read_bytes(path: Path, *, what: str = "picture", count: int = -1) -> bytes:
    """The content of a file, or its first ``count`` bytes. Raises CaptureError, which names ``what`` it is."""
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError as error:
        raise CaptureError(f"The {what} {path} cannot be read ({error.strerror}); restore it.") from None


def _may_be_deep(path: Path) -> bool:
    """Whether a file may hold more than 8 bits, by its header."""
    head = read_bytes(path, count=25)
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return head[24:25] == b"\x10"
    return head[:2] in (b"II", b"MM", b"P5", b"P6", b"\xff\x4f") or head[4:8] == b"jP  "


def stored_picture(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """The values of a file, ``[H, W]``, or ``[H, W, 3 or 4]`` in OpenCV's order of colours."""
    cv2, data = opencv(), read_bytes(path)
    if data[4:8] == b"ftyp" and data[8:12] in HEIF_BRANDS:
        return _heif_picture(path, data)
    if not data or is_cut_jpeg(data):
        raise _undecodable(path, data)
    # Calibrations are made on the stored pixels, so a rotation tag must not turn them.
    if data[:4] in (b"II*\0", b"MM\0*"):
        data = _upright_tiff(path, data)
    plain = data[:2] in (b"\xff\xd8", b"BM")  # JPEG; BMP, whose fourth byte is mostly unused, and 0
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION if plain else cv2.IMREAD_UNCHANGED
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        picture = None
    if picture is None:
        raise _undecodable(path, data)
    if picture.dtype not in (np.uint8, np.uint16):
        raise CaptureError(
            f"The picture {path} has values that are no whole numbers of 8 or 16 bits; expected sRGB of 8 or 16 bits: "
            "convert it, with the transfer function of sRGB if its values are linear."
        )
    return picture


def _undecodable(path: Path, data: bytes) -> CaptureError:
    return CaptureError(
        f"The picture {path} cannot be decoded ({len(data)} bytes, empty, cut or damaged); restore it, or move it out "
        "of the capture: its camera then is absent from that frame."
    )


def _upright_tiff(path: Path, data: bytes) -> bytes:
    """The same file with the orientation 1, since OpenCV turns pictures of TIFF whatever it is asked for.

    One that holds a take is refused; a thumbnail may follow the picture.
    """
    order = "<" if data[:2] == b"II" else ">"
    changed = bytearray(data)
    try:
        first, following = _tiff_directory(data, order, *struct.unpack_from(f"{order}I", data, 4))
        second = _tiff_directory(data, order, following)[0] if following else {}
        if ORIENTATION in first:
            struct.pack_into(f"{order}H", changed, first[ORIENTATION] + 8, 1)
    except struct.error:
        return data  # cut, which the decoder notices
    sizes = [[data[own[tag] + 2 : own[tag] + 12] for tag in TIFF_SIZE if tag in own] for own in (first, second)]
    if sizes[0] == sizes[1] != []:
        raise CaptureError(
            f"The picture {path} has several pages of one size, of which the first alone would be read; expected one "
            "picture a file: write each page to a file of its own (CAMERA/000000.tif, CAMERA/000001.tif, ...)."
        )
    return bytes(changed)


def _tiff_directory(data: bytes, order: str, at: int) -> tuple[dict[int, int], int]:
    """Where each tag of a TIFF's directory has its entry, and where the next directory lies; 0 without one."""
    (count,) = struct.unpack_from(f"{order}H", data, at)
    entries = range(at + 2, at + 2 + 12 * count, 12)
    (following,) = struct.unpack_from(f"{order}I", data, entries.stop)
    return {struct.unpack_from(f"{order}H", data, entry)[0]: entry for entry in entries}, following


def is_cut_jpeg(data: bytes) -> bool:
    """Whether a JPEG ends before its picture does. It decodes all the same, grey below the cut.

    The end marker is looked for behind the first scan, since thumbnails before it have one, and what follows a picture
    may be of any length (the videos of motion photos). Byte stuffing keeps the marker out of the picture's data.
    """
    if data[:2] != b"\xff\xd8":
        return False
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return data.find(b"\xff\xd9", at) < 0


def _heif_picture(path: Path, data: bytes) -> NDArray[np.uint8]:
    """The values of a HEIC or AVIF picture: HEIC is turned as it is shown, AVIF remains as it is stored."""
    is_avif = data[8:12] in (b"avif", b"avis")
    needs = "AVIF, which needs Pillow 11.3 or later" if is_avif else "HEIC, which needs the Python package pillow-heif"
    try:
        if is_avif:
            from PIL import Image, features

            if not features.check("avif"):
                raise ImportError
            image = Image.open(io.BytesIO(data))
        else:
            import pillow_heif  # pyright: ignore[reportMissingImports]

            image = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=True).to_pillow()
        pixels = np.array(image.convert("RGBA" if "A" in image.getbands() else "RGB"))
        if not is_avif:  # Pillow does not read its header, by which others are converted
            pixels[..., :3] = _in_srgb(np.ascontiguousarray(pixels[..., :3]), image.info.get("icc_profile"))
    except ImportError:
        raise CaptureError(
            f"The picture {path} is {needs}; install it, or convert the pictures to JPEG or PNG."
        ) from None
    except Exception:  # a damaged one can raise anything
        raise _undecodable(path, data) from None
    return np.ascontiguousarray(pixels[..., [2, 1, 0, 3][: pixels.shape[2]]])


def turned(picture: NDArray[Pixel], orientation: int) -> NDArray[Pixel]:
    """A picture ``[H, W, ...]`` as it is shown by its EXIF orientation, 1 to 8."""
    if orientation >= 5:
        picture = picture.swapaxes(0, 1)
    across, down = orientation in (2, 3, 6, 7), orientation in (3, 4, 7, 8)
    return np.ascontiguousarray(picture[:: -1 if down else 1, :: -1 if across else 1])


def reduced_picture(picture: NDArray[np.uint8], longest_side: int) -> NDArray[np.uint8]:
    """A picture ``[H, W]`` or ``[H, W, C]`` averaged over areas so that no side exceeds ``longest_side`` pixels."""
    height, width = picture.shape[:2]
    factor = longest_side / max(width, height)
    if factor >= 1:
        return picture
    size = (max(round(width * factor), 1), max(round(height * factor), 1))
    return np.asarray(opencv().resize(picture, size, interpolation=opencv().INTER_AREA), np.uint8)


def reduced_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """``mask`` ``[H, W]`` at another ``size``, width and height: a pixel counts if all that it averages count."""
    if mask.shape[1::-1] == size:
        return mask
    cv2 = opencv()
    shrinks = size[0] <= mask.shape[1] and size[1] <= mask.shape[0]
    taken = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return taken > 1 - 1e-4


MAX_SERIES = 8  # of names that differ by more than numbers, of which one picture is looked at


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of the stored pixels; other files than PNG and JPEG are decoded."""
    with _opened(path) as picture:
        if picture is not None and picture.format in ("PNG", "JPEG", "MPO"):
            return picture.size
    return stored_picture(path).shape[1::-1]


def check_one_series(camera: str, files: Iterable[Path]) -> None:
    """Refuses pictures of one camera that are of several series: names that differ by more than numbers, where the
    numbers are the same (depth maps, masks) or sizes are not (thumbnails)."""
    firsts: dict[str, Path] = {}
    numbered: dict[tuple[int, ...], tuple[str, Path]] = {}
    for file in files:
        kind = re.sub(r"\d+", "0", file.stem)
        firsts.setdefault(kind, file)
        numbers = tuple(map(int, re.findall(r"\d+", file.stem)))
        other, same = numbered.setdefault(numbers, (kind, file))
        if numbers and other != kind:
            raise CaptureError(
                f"The pictures of camera {camera!r} in {file.parent} are of several series: {same.name} and "
                f"{file.name} have the same number; expected one: move the other one out of the folder (masks to "
                "masks/CAMERA)."
            )
    sizes = {picture_size(file): file for file in islice(firsts.values(), MAX_SERIES)} if len(firsts) > 1 else {}
    if len(sizes) > 1:
        (one, first), (other, second) = [*sizes.items()][:2]
        raise CaptureError(
            f"The pictures of camera {camera!r} in {first.parent} are of several sizes, {first.name} of "
            f"{one[0]}x{one[1]} pixels and {second.name} of {other[0]}x{other[1]}; expected one series: move the other "
            "one out of the folder."
        )


@contextmanager
def _opened(path: Path) -> Iterator["ImageFile | None"]:
    """The picture with its header read; None if Pillow does not read it."""
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("Pillow", "capture") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged metadata; what is needed of them is checked where it is read
            picture = Image.open(path)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # what is no picture has no number
            raise CaptureError(f"The picture {path} cannot be read ({error.strerror}); restore it.") from None
        yield None
        return
    with picture:
        yield picture


EXIF_IFD = 0x8769
FOCAL_LENGTH, FOCAL_35MM = 0x920A, 0xA405
PLANE_RESOLUTION, PLANE_UNIT, PIXELS_ACROSS, PIXELS_DOWN = 0xA20E, 0xA210, 0xA002, 0xA003
MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""In the unit of the resolution of the focal plane: inch, and by common extension of TIFF centimetre, mm and µm."""
DIAGONAL_35MM = math.hypot(36.0, 24.0)
AGREE = 0.12
"""Share by which two focal lengths may differ: whole millimetres of 35 mm film are up to 3 % off, crops more."""
MIN_FOCAL_SHARE, MAX_FOCAL_SHARE = 0.2, 20.0
"""Focal lengths of lenses, relative to the longer side."""


@dataclass(frozen=True)
class StatedOptics:
    """Focal length and orientation of a picture by its header."""

    focal_pixels: float | None  # focal length in pixels of the picture; None if not stated
    orientation: int  # how the stored picture is to be turned (1 to 8; 1 is not at all)


def read_exif(path: Path) -> StatedOptics:
    """Focal length and orientation by a picture's header.

    The focal length comes from that of the lens and the resolution of its focal plane, as far as the equivalent one of
    35 mm film does not contradict it; else from that one, which is taken as of the diagonal.

    Files without such a header, or with a damaged one, state nothing; whether the picture can be decoded is not looked
    at.
    """
    with _opened(path) as picture:
        if picture is None:
            return StatedOptics(None, 1)
        try:
            size, tags = picture.size, picture.getexif()
            detail: Mapping[int, Any] = tags.get_ifd(EXIF_IFD)
            orientation = tags.get(ORIENTATION, 1)
        except (OSError, SyntaxError, ValueError):
            return StatedOptics(None, 1)
    whole = orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1
    return StatedOptics(_focal_pixels(detail, size), whole)


def _focal_pixels(tags: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    film = _number(tags.get(FOCAL_35MM)) * math.hypot(*size) / DIAGONAL_35MM
    found = (_by_plane(tags, size), film)
    likely = [focal for focal in found if MIN_FOCAL_SHARE < focal / max(size) < MAX_FOCAL_SHARE]
    if len(likely) == 2 and abs(likely[0] / likely[1] - 1) > AGREE:
        return film
    return likely[0] if likely else None


def _by_plane(tags: Mapping[int, Any], size: tuple[int, int]) -> float:
    """By the resolution of the sensor for the picture as it was taken, which may have been reduced since; or NaN."""
    unit = MILLIMETRES.get(tags.get(PLANE_UNIT, 2), math.nan)
    focal = _number(tags.get(FOCAL_LENGTH)) * _number(tags.get(PLANE_RESOLUTION)) / unit
    across, down = _number(tags.get(PIXELS_ACROSS)), _number(tags.get(PIXELS_DOWN))
    if math.isfinite(across + down):  # The longer sides: what turns a picture seldom turns its tags.
        return focal * max(size) / max(across, down)
    return focal * size[0] / (size[0] if math.isnan(across) else across)


def _number(value: object) -> float:
    """A positive number; NaN for anything else, as tags of 0 and 0/0 that mean unknown."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
    return number if 0 < number < math.inf else math.nan
