# SPDX-License-Identifier: Apache-2.0
"""Pictures that a calibration is made from."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.errors import CalibrationError, CaptureError


def checked_pictures(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    masks: Mapping[str, Sequence[NDArray[np.bool_]]] | None = None,
    cameras: Mapping[str, LensCamera] | None = None,
) -> None:
    """Check that cameras have pictures of the same instants and one size each: that of ``cameras``, if given.

    Raises:
        CaptureError: a camera without pictures or with fewer than the others, or masks of another shape.
        CalibrationError: a camera whose pictures change their size, or have another than its calibration.
    """
    counts = {name: len(shots) for name, shots in pictures.items()}
    if not counts or 0 in counts.values() or len(set(counts.values())) > 1:
        told = ", ".join(f"{name!r} {count}" for name, count in counts.items()) or "none"
        raise CaptureError(f"Every camera needs pictures of the same instants; got: {told}.")
    for name, shots in pictures.items():
        sizes = sorted({f"{shot.shape[1]}x{shot.shape[0]}" for shot in shots})
        if len(sizes) > 1:
            raise CalibrationError(f"The pictures of camera {name!r} have {' and '.join(sizes)} pixels; expected one.")
        given = () if masks is None else masks.get(name, ())
        if given and (len(given) != len(shots) or any(mask.shape != shots[0].shape[:2] for mask in given)):
            raise CaptureError(
                f"The masks of camera {name!r} do not fit its pictures; expected {len(shots)} of {sizes[0]} pixels."
            )
    for name, filmed in (cameras or {}).items():
        if name not in pictures:
            raise CaptureError(f"There are no pictures of camera {name!r}, which is calibrated; it needs some.")
        height, width = pictures[name][0].shape[:2]
        if (width, height) != (filmed.camera.width, filmed.camera.height):
            raise CalibrationError(
                f"The pictures of camera {name!r} have {width}x{height} pixels, its calibration is for "
                f"{filmed.camera.width}x{filmed.camera.height}; scale the one to the other."
            )
