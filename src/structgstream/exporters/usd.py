# SPDX-License-Identifier: Apache-2.0
"""OpenUSD: one prim ``ParticleField3DGaussianSplat`` (OpenUSD 26.03) with a time sample of each frame.

Time codes are frame numbers of the stream, and the stage has its frames per second. y points up. Scales and opacities
are stored as they are, spherical harmonics Gaussian by Gaussian, the constant coefficient first. An older library than
26.03 writes the same prim and attributes without knowing their schema.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from structgstream.errors import MissingExtraError
from structgstream.exporters.baked_gaussians import BakedGaussians

# pxr has no types.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

PRIM_TYPE = "ParticleField3DGaussianSplat"


class UsdFile:
    """Collects frames and writes them to one file."""

    def __init__(self, *, fps: float) -> None:
        """Begin a file.

        Raises:
            MissingExtraError: usd-core is not installed.
        """
        try:
            from pxr import Sdf, Usd, UsdGeom
        except ImportError:
            raise MissingExtraError("pxr", "export") from None
        self._stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(self._stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(self._stage, 1.0)
        self._stage.SetTimeCodesPerSecond(fps)
        self._stage.SetFramesPerSecond(fps)
        prim = self._stage.DefinePrim("/Splats", PRIM_TYPE)
        self._stage.SetDefaultPrim(prim)
        types = Sdf.ValueTypeNames
        self._attributes = {
            name: prim.CreateAttribute(name, type, custom=False)
            for name, type in {
                "positions": types.Point3fArray,
                "orientations": types.QuatfArray,
                "scales": types.Float3Array,
                "opacities": types.FloatArray,
                "radiance:sphericalHarmonicsCoefficients": types.Float3Array,
                "extent": types.Float3Array,
            }.items()
        }
        self._degree = prim.CreateAttribute(
            "radiance:sphericalHarmonicsDegree", types.Int, False, Sdf.VariabilityUniform
        )
        self._numbers: list[int] = []

    def add(self, number: int, gaussians: BakedGaussians) -> None:
        """Add a frame: OpenCV axes, in the units of the file."""
        from pxr import Vt

        gaussians = gaussians.y_up()
        reach = 3.0 * gaussians.scales.max(1, keepdim=True).values
        extent = torch.stack([(gaussians.means - reach).min(0).values, (gaussians.means + reach).max(0).values])
        samples: dict[str, Any] = {
            "positions": Vt.Vec3fArray.FromNumpy(_array(gaussians.means)),
            "orientations": Vt.QuatfArray.FromNumpy(_array(gaussians.quats[:, [1, 2, 3, 0]])),
            "scales": Vt.Vec3fArray.FromNumpy(_array(gaussians.scales)),
            "opacities": Vt.FloatArray.FromNumpy(_array(gaussians.opacities)),
            "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(_array(gaussians.sh.flatten(0, 1))),
            "extent": Vt.Vec3fArray.FromNumpy(_array(extent)),
        }
        for name, value in samples.items():
            self._attributes[name].Set(value, number)
        self._degree.Set(gaussians.degree)
        self._numbers.append(number)

    def save(self, path: Path) -> None:
        """Write the file; its suffix says whether it is binary or text."""
        self._stage.SetStartTimeCode(self._numbers[0])
        self._stage.SetEndTimeCode(self._numbers[-1])
        self._stage.GetRootLayer().Export(str(path))


def _array(values: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.cpu().numpy(), np.float32)
