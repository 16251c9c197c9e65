# SPDX-License-Identifier: Apache-2.0
"""LDR-FLIP (Andersson et al., 2020): how visible a difference is when two pictures are flipped between on a display."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import MissingExtraError


def flip_evaluator() -> Callable[..., tuple[NDArray[np.float32], float, dict]]:
    """The function that computes FLIP, its authors' own.

    Raises:
        MissingExtraError: the package is not installed.
    """
    try:
        from flip_evaluator import evaluate
    except ImportError:
        raise MissingExtraError("flip_evaluator", "eval") from None
    return evaluate


def flip_map(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float32]:
    """FLIP of every pixel ``[H, W]``, in [0, 1], of two 8-bit sRGB pictures ``[H, W, 3]``.

    At the default viewing conditions: 0.7 m from a display 0.7 m wide with 3840 pixels across, 67.02 pixels a degree.

    Raises:
        MissingExtraError: the package is not installed.
    """
    # The package takes whatever it is given for [0, 1], bytes too.
    reference, test = (np.divide(p, 255.0, dtype=np.float32) for p in (truth, picture))
    return flip_evaluator()(reference, test, "LDR", applyMagma=False, computeMeanError=False)[0][..., 0]


def flip(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """Mean of :func:`flip_map`; 0 for equal pictures, 1 at most."""
    return float(flip_map(picture, truth).mean(dtype=np.float64))
