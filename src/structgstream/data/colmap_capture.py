# SPDX-License-Identifier: Apache-2.0
"""Captures calibrated by a COLMAP model, beside ``sparse/0``, ``sparse`` or model files in the folder itself."""

from pathlib import Path

from structgstream.data.colmap import find_model, read_model
from structgstream.data.posed_capture import open_posed
from structgstream.data.source import FrameSource
from structgstream.errors import CaptureError


def recognizes_colmap(path: Path) -> bool:
    """Whether the folder has a COLMAP model."""
    return find_model(path) is not None


def open_colmap(path: Path) -> FrameSource:
    """The capture at ``path``; nothing is held out, and the model's points come along.

    Raises:
        CaptureError: no pictures or videos beside the model, or not of the model's cameras.
        CalibrationError: a broken model, a camera without calibration, or one that moves.
    """
    folder = find_model(path)
    if folder is None:
        raise CaptureError(f"{path} has no COLMAP model; expected cameras, images and points3D in sparse/0.")
    return open_posed(path, read_model(folder))
