# SPDX-License-Identifier: Apache-2.0
"""What a video states of its colours, and the conversion of HLG and PQ (ITU-R BT.2100) to sRGB.

Both are converted to light on a display: of HLG for a display of 1000 cd/m2, as BT.2100 has it. Reference white, 203
cd/m2 (ITU-R BT.2408), becomes 1; what is brighter than three quarters of it is compressed smoothly, by the brightest
channel, so that hues remain.

Every frame of a file is converted alike, so still things keep their colours.
"""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import CaptureError

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

# Numbers of ISO/IEC 23091-2.
UNSPECIFIED, PQ, HLG, BT2020 = 2, 16, 18, 9
HIGH_RANGE = frozenset({PQ, HLG})
DISPLAY_REFERRED = frozenset({0, 1, UNSPECIFIED, 4, 5, 6, 7, 11, 12, 13, 14, 15})
TRANSFERS = {1: "BT.709", 4: "gamma 2.2", 5: "gamma 2.8", 6: "BT.601", 7: "SMPTE 240M", 8: "linear", 9: "logarithmic",
             10: "logarithmic", 11: "xvYCC", 12: "BT.1361", 13: "sRGB", 14: "BT.2020", 15: "BT.2020", PQ: "PQ",
             17: "SMPTE 428", HLG: "HLG"}  # fmt: skip
PRIMARIES = {1: "BT.709", 4: "BT.470M", 5: "BT.470BG", 6: "SMPTE 170M", 7: "SMPTE 240M", BT2020: "BT.2020",
             11: "DCI-P3", 12: "Display P3"}  # fmt: skip
MATRICES = {0: "RGB", 1: "BT.709", 4: "FCC", 5: "BT.601", 6: "BT.601", 7: "SMPTE 240M", 8: "YCgCo", 9: "BT.2020",
            10: "BT.2020 constant luminance"}  # fmt: skip

WHITE, PEAK, KNEE = 203.0, 1000.0, 0.75
"""Reference white and the display's peak, cd/m2; where compression begins, relative to reference white."""
BT2020_TO_709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)  # ITU-R BT.2087
LUMA_2020 = np.array([0.2627, 0.6780, 0.0593], np.float32)


def transfer_of(frame: "VideoFrame") -> int:
    """The transfer function that a frame states, as the number of ISO/IEC 23091-2."""
    return int(getattr(frame, "color_trc", UNSPECIFIED))


def stated_colors(path: Path, frame: "VideoFrame | None") -> str:
    """What a video states of its colours, in words.

    Args:
        frame: one of its frames; None where none decodes.

    Raises:
        CaptureError: a transfer function that is not converted, or wide primaries without any, as log videos have.
    """
    if frame is None:
        return "no frame decodes"
    transfer, primaries = transfer_of(frame), int(getattr(frame, "color_primaries", UNSPECIFIED))
    if transfer == UNSPECIFIED and primaries == BT2020:
        raise CaptureError(
            f"The video {path} has the primaries of BT.2020 and does not state its transfer function, as log videos "
            "have it, so its colours are unknown; convert it to BT.709 with the camera maker's conversion, keeping the "
            "time of each frame, or film in standard range."
        )
    if transfer not in DISPLAY_REFERRED | HIGH_RANGE:
        what = TRANSFERS.get(transfer, f"number {transfer}")
        raise CaptureError(
            f"The video {path} states a transfer function ({what}) that is not read; expected BT.709, sRGB, BT.2020, "
            "HLG or PQ: convert it to BT.709, keeping the time of each frame."
        )
    matrix = MATRICES.get(int(frame.colorspace), "no matrix stated")
    bounds = {1: "limited range", 2: "full range"}.get(int(frame.color_range), "no range stated")
    words = [frame.format.name, matrix, bounds]
    words += [f"primaries {PRIMARIES[primaries]}"] if primaries in PRIMARIES else []
    words += [TRANSFERS[transfer]] if transfer in TRANSFERS else []
    words += ["converted to sRGB"] if transfer in HIGH_RANGE else []
    return ", ".join(words)


def high_range_to_srgb(picture: NDArray[np.uint16], transfer: int, *, wide: bool) -> NDArray[np.uint8]:
    """sRGB ``[H, W, 3]`` of a picture of high dynamic range.

    Args:
        picture: ``[H, W, 3]``, full range.
        transfer: :data:`HLG` or :data:`PQ`.
        wide: whether its primaries are those of BT.2020; else they are those of BT.709.
    """
    light = _decoding(transfer)[picture]
    if transfer == HLG:  # Scene light to a display's, by luminance: the system gamma of 1.2.
        light *= np.maximum(light @ LUMA_2020, 1e-9)[..., None] ** np.float32(0.2) * np.float32(PEAK / WHITE)
    if wide:
        light = light @ BT2020_TO_709.T
    np.maximum(light, 0, out=light)
    brightest = np.maximum(light.max(axis=2, keepdims=True), 1e-9)
    shoulder = KNEE + (1 - KNEE) * -np.expm1((KNEE - brightest) / (1 - KNEE))
    light *= np.where(brightest > KNEE, shoulder / brightest, 1)
    return _encoding()[(np.minimum(light, 1) * 4095 + 0.5).astype(np.uint16)]


@cache
def _decoding(transfer: int) -> NDArray[np.float32]:
    """Light of each of 65536 values: of HLG the scene's, up to 1; of PQ the display's, reference white 1."""
    signal = np.linspace(0, 1, 65536)
    if transfer == HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    else:
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        root = signal ** (1 / m2)
        light = (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1) * 10000 / WHITE
    return light.astype(np.float32)


@cache
def _encoding() -> NDArray[np.uint8]:
    """sRGB of each of 4096 values of light."""
    light = np.linspace(0, 1, 4096)
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (coded * 255 + 0.5).astype(np.uint8)
