# SPDX-License-Identifier: Apache-2.0
"""The container ``.4dgs`` (Apache-2.0, https://4dgs.dev): each Gaussian lives from its frame to the next.

The library quantizes positions, scales, rotations and colours within stated bounds, and coefficients above the constant
one to 8 bits. Gaussians of different frames are not linked, so nothing is predicted from frame to frame.
"""

from pathlib import Path

import numpy as np

from structgstream.errors import MissingExtraError
from structgstream.exporters.baked_gaussians import BakedGaussians
from structgstream.scene.harmonics import Y0

# An optional package.
# pyright: reportMissingImports=false


class FourDgsFile:
    """Collects frames and writes them to one file."""

    def __init__(self, *, fps: float) -> None:
        """Begin a file.

        Raises:
            MissingExtraError: fourdgs is not installed.
        """
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
