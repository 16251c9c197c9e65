# SPDX-License-Identifier: Apache-2.0
"""The ``.ply`` format of the 3D Gaussian splatting code (Kerbl et al. 2023), which every viewer and editor reads.

It has one element ``vertex`` in binary little endian. Every property is a float32: position, an unused normal, the
constant colour coefficients ``f_dc``, the others ``f_rest`` (all of red, then green, then blue), the logit of the
opacity, logarithms of the scales, and a quaternion wxyz.
"""

from dataclasses import replace

import numpy as np
import torch

from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.exporters.formats import MAX_SH_DEGREE, FrameOptions

MIN_OPACITY = 1e-6  # A logit of 0 or 1 is not finite.


def properties(degree: int) -> list[str]:
    """Names of the properties, in order, of spherical harmonics of ``degree``."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    colors = [f"f_dc_{i}" for i in range(3)] + rest
    shape = [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    return ["x", "y", "z", "nx", "ny", "nz", *colors, "opacity", *shape]


def ply_bytes(gaussians: BakedGaussians, options: FrameOptions | None = None) -> bytes:
    """A whole ``.ply`` file, in the units and axes of ``gaussians``."""
    if options is not None and options.pad_sh:
        missing = (MAX_SH_DEGREE + 1) ** 2 - gaussians.sh.shape[1]
        gaussians = replace(gaussians, sh=torch.nn.functional.pad(gaussians.sh, (0, 0, 0, missing)))
    names = properties(gaussians.degree)
    lines = ["ply", "format binary_little_endian 1.0", "comment axes: x right, y down, z forward"]
    lines += [f"element vertex {len(gaussians)}", *(f"property float {name}" for name in names), "end_header"]
    columns = [
        gaussians.means,
        torch.zeros_like(gaussians.means),
        gaussians.sh[:, 0],
        gaussians.sh[:, 1:].transpose(1, 2).flatten(1),
        gaussians.opacities.clamp(MIN_OPACITY, 1.0 - MIN_OPACITY).logit()[:, None],
        gaussians.scales.log(),
        gaussians.quats,
    ]
    table = torch.cat(columns, dim=1).cpu().numpy().astype(np.dtype("<f4"))
    return "\n".join([*lines, ""]).encode("ascii") + table.tobytes()
