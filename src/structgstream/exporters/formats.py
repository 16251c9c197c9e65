# SPDX-License-Identifier: Apache-2.0
"""The table of formats, and the options of an export; imports no torch, so that the help of a command is fast."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from structgstream.errors import ConfigError

Format = Literal["ply", "splat", "spz", "sog", "glb", "usd", "4dgs"]
"""Formats of plain 3D Gaussians."""
PageFormat = Literal["html", "site"]
"""Formats of the whole stream with a player: a single page, or a folder for a web server."""
PAGES: tuple[PageFormat, ...] = get_args(PageFormat)
SpzVersion = Literal[2, 3, 4]
MAX_SH_DEGREE = 3


@dataclass(frozen=True)
class FormatInfo:
    """A row of the table.

    Args:
        purpose: what the format is good for.
        readers: programs that open it.
        max_degree: highest degree of spherical harmonics.
        all_frames: whether one file contains all frames.
        suffixes: further endings of file names.
    """

    purpose: str
    readers: str
    max_degree: int = MAX_SH_DEGREE
    all_frames: bool = False
    suffixes: tuple[str, ...] = ()


FORMATS: Mapping[Format, FormatInfo] = {
    "ply": FormatInfo(
        "editing; numbered files are a sequence in SuperSplat",
        "SuperSplat, Brush, Postshot, Blender, Unity and Unreal importers",
    ),
    "splat": FormatInfo("oldest web viewers; one colour a Gaussian", "antimatter15/splat, Spark, Babylon.js", 0),
    "spz": FormatInfo("small files for the web", "Niantic Scaniverse, Spark, PlayCanvas, Babylon.js, Cesium"),
    "sog": FormatInfo("smallest files for the web", "PlayCanvas, SuperSplat, Spark"),
    "glb": FormatInfo(
        "glTF pipelines (KHR_gaussian_splatting)", "Khronos Sample Renderer, Cesium, Babylon.js, PlayCanvas, three.js"
    ),
    "usd": FormatInfo(
        "film and simulation tools: all frames in one file, as time samples",
        "OpenUSD from 26.03: usdview, Arnold, Omniverse",
        all_frames=True,
        suffixes=("usdc", "usda"),
    ),
    "4dgs": FormatInfo(
        "archive of all frames in one seekable file with an open specification", "fourdgs, 4dgs-viewer", all_frames=True
    ),
}
SUFFIXES: Mapping[str, Format] = {suffix: name for name, info in FORMATS.items() for suffix in (name, *info.suffixes)}
"""Format by the ending of a file's name."""


@dataclass(frozen=True)
class FrameOptions:
    """Options of frames as plain 3D Gaussians.

    Args:
        degree: degree of the spherical harmonics; None for 1, or for 0 in a format without.
        low_pass: variance by which Gaussians are widened, squared training pixels (``bake.with_low_pass``).
        box: two opposite corners, in the capture's units; Gaussians with means outside are left out.
        min_opacity: Gaussians below this opacity are left out.
        max_splats: largest number of Gaussians of a frame; the smallest and most transparent are left out.
        pad_sh: write all 45 ``f_rest`` properties of a ``.ply``, which some importers need.
        spz_version: version of ``.spz``.
    """

    degree: int | None = None
    low_pass: float = 0.0
    box: tuple[float, float, float, float, float, float] | None = None
    min_opacity: float = 0.0
    max_splats: int | None = None
    pad_sh: bool = False
    spz_version: SpzVersion = 2

    def check(self, format: Format) -> None:
        """Check the values, and that ``format`` supports them.

        Raises:
            ConfigError: a value is out of range, or the format does not support it.
        """
        highest = FORMATS[format].max_degree
        if self.degree is not None and not 0 <= self.degree <= MAX_SH_DEGREE:
            raise ConfigError(f"--sh-degree {self.degree} is not one of 0 to {MAX_SH_DEGREE}.")
        if (self.degree or 0) > highest:
            raise ConfigError(f"a .{format} file has one colour per Gaussian; --sh-degree {self.degree} needs another.")
        if not 0.0 <= self.low_pass <= 1.0:
            raise ConfigError(
                f"--low-pass {self.low_pass:g} is no variance in squared training pixels; expected 0 to 1."
            )
        if not 0.0 <= self.min_opacity < 1.0:
            raise ConfigError(f"--min-opacity {self.min_opacity:g} is no opacity; expected 0 to 1, without 1.")
        if self.max_splats is not None and self.max_splats < 1:
            raise ConfigError(f"--max-splats {self.max_splats} leaves no Gaussian; expected 1 or more.")
        if self.box is not None and not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)):
            raise ConfigError("--crop names the lowest x, y, z and then the highest; the box has no volume.")
        if self.pad_sh and format != "ply":
            raise ConfigError(f"--pad-sh is for .ply files, not for .{format}.")
        if self.spz_version != 2 and format != "spz":
            raise ConfigError(f"--spz-version is for .spz files, not for .{format}.")

    def baked_degree(self, format: Format) -> int:
        """The degree to fit."""
        return min(1, FORMATS[format].max_degree) if self.degree is None else self.degree
