# SPDX-License-Identifier: Apache-2.0
"""Formats with all frames in one file: OpenUSD and ``.4dgs``. Both have y up.

OpenUSD has one prim ``ParticleField3DGaussianSplat`` (OpenUSD 26.03) with a time sample of each frame. Time codes are
frame numbers of the stream, and the stage has its frames per second. Scales and opacities are stored as they are,
spherical harmonics Gaussian by Gaussian, the constant coefficient first. An older library than 26.03 writes the same
prim and attributes without knowing their schema.

In ``.4dgs`` (Apache-2.0, https://4dgs.dev) each Gaussian lives from its frame to the next. The library quantizes
positions, scales, rotations and colours within stated bounds, and coefficients above the constant one to 8 bits.
Gaussians of different frames are not linked, so nothing is predicted from frame to frame.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from structgstream.errors import MissingExtraError
from structgstream.exporters.bake import BakedGaussians
from structgstream.scene.harmonics import Y0

# pxr has no types.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

PRIM_TYPE = "ParticleField3DGaussianSplat"


class UsdFile:
    """Collects frames and writes them to one file."""

    def __init__(self, *, fps: float) -> None:
        """Begin a file. Raises MissingExtraError if usd-core is not installed."""
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


# An optional package.
# pyright: reportMissingImports=false


class FourDgsFile:
    """Collects frames and writes them to one file."""

    def __init__(self, *, fps: float) -> None:
        """Begin a file. Raises MissingExtraError if fourdgs is not installed."""
        try:
            import fourdgs  # noqa: F401
        except ImportError:
            raise MissingExtraError("fourdgs", "export") from None
        self._fps = fps
        self._frames: list[dict[str, np.ndarray]] = []
        self._degree = 0

    def add(self, number: int, gaussians: BakedGaussians) -> None:
        """Add a frame: OpenCV axes, in the units of the file."""
        from fourdgs.quantization import SH_QUANT_HI, SH_QUANT_LO

        gaussians = gaussians.y_up()
        self._degree = gaussians.degree
        place, count = len(self._frames), len(gaussians)
        rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1).cpu().numpy()
        color = (0.5 + Y0 * gaussians.sh[:, 0]).clamp(0.0, 1.0).cpu().numpy()
        start = np.full(count, place / self._fps)
        self._frames.append(
            {
                "positions": gaussians.means.cpu().numpy(),
                "scales": gaussians.scales.cpu().numpy(),
                "rotations": gaussians.quats[:, [1, 2, 3, 0]].cpu().numpy(),
                "colors": np.concatenate([color, gaussians.opacities.cpu().numpy()[:, None]], axis=1),
                "sh": np.rint((rest - SH_QUANT_LO) / (SH_QUANT_HI - SH_QUANT_LO) * 255).clip(0, 255).astype(np.uint8),
                "win_lo": start,
                "win_hi": np.full(count, (place + 1) / self._fps),
                "mu_t": start,
                "motions": np.zeros((count, 3)),
                "sigma_t": np.full(count, np.inf),
            }
        )

    def save(self, path: Path) -> None:
        """Write the file."""
        from fourdgs import GaussianSet, WriteOptions, write

        columns = {name: np.concatenate([frame[name] for frame in self._frames]) for name in self._frames[0]}
        exact = {"sh", "win_lo", "win_hi"}
        columns = {name: value if name in exact else value.astype(np.float32) for name, value in columns.items()}
        if not self._degree:
            columns.pop("sh")
        metadata = {"coordinate_system": "y-up-right-handed", "color_space": "srgb-rec709-display"}
        options = WriteOptions(library="structgstream", metadata=metadata)
        write(str(path), GaussianSet(**columns, sh_degree=self._degree), len(self._frames) / self._fps, options=options)
