# SPDX-License-Identifier: Apache-2.0
"""What the files of cameras say of their lenses."""

from collections.abc import Mapping

from structgstream.data.calibration import listed
from structgstream.data.exif import read_exif
from structgstream.preparation.footage import Footage


def stated_focals(footage: Footage) -> dict[str, float]:
    """Focal lengths in pixels of those cameras whose first picture states one (Exif); videos do not.

    Raises:
        CaptureError: a picture cannot be read.
        MissingExtraError: Pillow is not installed.
    """
    stated = {name: read_exif(files[0]).focal_pixels for name, files in footage.stills.items()}
    return {name: focal for name, focal in stated.items() if focal is not None}


def focals_told(focals: Mapping[str, float], footage: Footage) -> str:
    """What was stated, in words; empty for nothing."""
    if not focals:
        return ""
    shares = sorted(focal / max(footage.size(name)) for name, focal in focals.items())
    span = f"{shares[0]:.3f}" + (f" to {shares[-1]:.3f}" if shares[-1] - shares[0] > 5e-4 else "")
    return (
        f"began with the focal lengths that the pictures of {len(focals)} of {len(footage.cameras)} cameras state "
        f"({span} of the longer side)"
    )


def turns_told(footage: Footage) -> str:
    """Which cameras' pictures are to be turned to be seen upright (Exif), in words; empty for none.

    A prepared capture has pixels as they are stored, so pictures are never turned: that is said, not done.

    Raises:
        CaptureError: a picture cannot be read.
        MissingExtraError: Pillow is not installed.
    """
    turned = [name for name, files in footage.stills.items() if read_exif(files[0]).orientation != 1]
    if not turned:
        return ""
    return (
        f"the files of {listed(turned)} say that pictures are to be turned (Exif orientation), and they are taken as "
        "they are stored: turn them without loss (exiftran -a, jpegtran) to have them upright"
    )
