# SPDX-License-Identifier: Apache-2.0
"""The ``.splat`` format of web viewers: 32 bytes per Gaussian without a header, the most important ones first.

A Gaussian has float32 position and scales (not logarithms), 8-bit red, green, blue and opacity, and an 8-bit quaternion
wxyz with the components ``(byte - 128) / 128``. Its colour does not depend on the direction.
"""

import numpy as np
import torch
from torch import Tensor

from structgstream.errors import ConfigError
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.exporters.formats import FrameOptions
from structgstream.scene.harmonics import Y0

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def splat_bytes(gaussians: BakedGaussians, options: FrameOptions | None = None) -> bytes:
    """A whole ``.splat`` file, in the units and axes of ``gaussians``.

    Raises:
        ConfigError: colours depend on direction. Their constant coefficient alone is not the mean over the cameras.
    """
    if gaussians.degree:
        raise ConfigError(
            f"A .splat file has one colour per Gaussian, got spherical harmonics of degree {gaussians.degree}; "
            "bake with degree 0."
        )
    gaussians = gaussians.select(gaussians.by_importance())  # a partly loaded file shows the largest ones
    rows = np.empty(len(gaussians), ROW)
    rows["mean"] = gaussians.means.cpu().numpy()
    rows["scale"] = gaussians.scales.cpu().numpy()
    rows["rgba"] = _bytes(255.0 * torch.cat([0.5 + Y0 * gaussians.sh[:, 0], gaussians.opacities[:, None]], dim=1))
    rows["quat"] = _bytes(128.0 * torch.nn.functional.normalize(gaussians.quats, dim=1) + 128.0)
    return rows.tobytes()


def _bytes(values: Tensor) -> np.ndarray:
    return values.round().clamp(0, 255).to(torch.uint8).cpu().numpy()
