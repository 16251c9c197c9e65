# SPDX-License-Identifier: Apache-2.0
"""The ``.ply`` format of the 3D Gaussian splatting code (Kerbl et al. 2023), which every viewer and editor reads:
written, and read as a numbered sequence.

It has one element ``vertex`` in binary little endian. Every property is a float32: position, an unused normal, the
constant colour coefficients ``f_dc``, the others ``f_rest`` (all of red, then green, then blue), the logit of the
opacity, logarithms of the scales, and a quaternion wxyz.
"""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from structgstream.errors import CaptureError
from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import MAX_SH_DEGREE, FrameOptions

MIN_OPACITY = 1e-6  # A logit of 0 or 1 is not finite.


def properties(degree: int) -> list[str]:
    """Names of the properties, in order, of spherical harmonics of ``degree``."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    colors = [f"f_dc_{i}" for i in range(3)] + rest
    shape = [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    return ["x", "y", "z", "nx", "ny", "nz", *colors, "opacity", *shape]


def ply_bytes(gaussians: BakedGaussians, options: FrameOptions) -> bytes:
    """A whole ``.ply`` file, in the units and axes of ``gaussians``."""
    if options.pad_sh:
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


TYPES = {
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("int", "int32"), "<i4"),
}
_OPTIONAL = {"nx", "ny", "nz"}
_MAX_HEADER_BYTES = 1 << 16


@dataclass(frozen=True)
class PlyHeader:
    """The header of a file."""

    count: int  # number of Gaussians
    row: np.dtype  # names and types of a Gaussian's properties
    offset: int  # byte at which the first row begins
    degree: int
    unread: tuple[str, ...]  # what it has beside plain Gaussians


def find_sequence(folder: Path) -> list[Path]:
    """The ``.ply`` files of ``folder`` in the order of the last number of their names. Raises CaptureError if there are
    none, names have several prefixes or no number, or numbers are missing."""
    entries = sorted(folder.iterdir()) if folder.is_dir() else []
    # macOS leaves a hidden ._NAME for each NAME on foreign file systems.
    files = [entry for entry in entries if entry.suffix.lower() == ".ply" and not entry.name.startswith(".")]
    if not files:
        raise CaptureError(f"{folder} is no folder with numbered .ply files, such as frame_000000.ply.")
    found: dict[int, Path] = {}
    prefixes = set()
    for file in files:
        match = re.fullmatch(r"(.*?)(\d+)(\D*)", file.stem)
        if match is None:
            raise CaptureError(f"{file.name} has no number; expected names such as frame_000000.ply in {folder}.")
        prefixes.add((match[1], match[3]))
        if int(match[2]) in found:
            raise CaptureError(f"{found[int(match[2])].name} and {file.name} have the same number; remove one of them.")
        found[int(match[2])] = file
    if len(prefixes) > 1:
        names = " and ".join(f"{before}N{after}.ply" for before, after in sorted(prefixes)[:2])
        raise CaptureError(f"{folder} has names of more than one sequence, {names}; put each into its own folder.")
    numbers = sorted(found)
    step = math.gcd(*(number - numbers[0] for number in numbers)) if len(numbers) > 1 else 1
    wanted = range(numbers[0], numbers[-1] + 1, step)
    missing = [number for number in wanted if number not in found]
    if missing:
        raise CaptureError(
            f"{len(missing)} of {len(wanted)} frames are missing in {folder}, the first is number {missing[0]}; "
            "add them, or number the files without gaps."
        )
    return [found[number] for number in numbers]


def read_header(path: Path) -> PlyHeader:
    """The header of a ``.ply`` of Gaussians. Raises CaptureError if it is not one, or lacks a property."""
    with path.open("rb") as file:
        data = file.read(_MAX_HEADER_BYTES)
    end_of_header = re.search(rb"\nend_header\r?\n", data)
    if data[:3] != b"ply" or end_of_header is None:
        raise CaptureError(f"{path} is not a .ply file.")
    text = data[: end_of_header.start()]
    words = [line.split() for line in text.decode("ascii", "replace").split("\n")]
    if ["format", "binary_little_endian", "1.0"] not in words:
        raise CaptureError(f"{path} is not binary little endian; convert it, for example with SuperSplat.")
    elements = [line for line in words if line[:1] == ["element"]]
    if not elements or elements[0][1:2] != ["vertex"] or not "".join(elements[0][2:]).isdigit():
        hint = " (it is a compressed .ply of SuperSplat; save it uncompressed)" if b"element chunk" in text else ""
        raise CaptureError(f"{path} does not begin with an element vertex{hint}.")
    end = words.index(elements[1]) if len(elements) > 1 else len(words)
    fields = [line for line in words[:end] if line[:1] == ["property"]]
    if any(len(line) != 3 or line[1] not in TYPES for line in fields):
        raise CaptureError(f"{path} has properties of vertices that are lists or of unknown types.")
    names = {name for _, _, name in fields}
    if len(names) < len(fields):
        raise CaptureError(f"{path} has two properties of one name, so which one is meant is unknown; write it again.")
    row = np.dtype([(name, TYPES[kind]) for _, kind, name in fields])
    rest = len([name for name in names if name.startswith("f_rest_")])
    degree = math.isqrt(rest // 3 + 1) - 1
    wanted = properties(min(degree, MAX_SH_DEGREE))
    if missing := [name for name in wanted if name not in names | _OPTIONAL]:
        raise CaptureError(f"{path} lacks the property {missing[0]}; it is not a .ply of 3D Gaussian splatting.")
    if degree > MAX_SH_DEGREE or rest != 3 * ((degree + 1) ** 2 - 1):
        raise CaptureError(f"{path} has {rest} properties f_rest, which is no degree of spherical harmonics to 3.")
    unread = [name for _, _, name in fields if name not in wanted]
    unread += [f"element {' '.join(element[1:2])}" for element in elements[1:] if element[2:] != ["0"]]
    return PlyHeader(int(elements[0][2]), row, end_of_header.end(), degree, tuple(unread))


def read_ply(path: Path) -> BakedGaussians:
    """The Gaussians of a ``.ply``, in its units and axes; quaternions are normalised. Raises CaptureError if the file
    is not a ``.ply`` of Gaussians, is cut, or has values that are not finite."""
    header = read_header(path)
    whole = max(path.stat().st_size - header.offset, 0) // header.row.itemsize
    if whole < header.count:
        raise CaptureError(f"{path} ends after {whole} of {header.count} Gaussians.")
    rows = np.fromfile(path, header.row, header.count, offset=header.offset)

    def columns(*names: str) -> Tensor:
        return torch.from_numpy(np.stack([rows[name].astype(np.float32) for name in names], axis=1))

    count, coefficients = header.count, (header.degree + 1) ** 2 - 1
    rest = [columns(*(f"f_rest_{i}" for i in range(3 * coefficients))).reshape(count, 3, -1)] if coefficients else []
    found = BakedGaussians(
        means=columns("x", "y", "z"),
        quats=torch.nn.functional.normalize(columns(*(f"rot_{i}" for i in range(4))), dim=1),
        scales=columns(*(f"scale_{i}" for i in range(3))).exp(),
        opacities=columns("opacity")[:, 0].sigmoid(),
        sh=torch.cat([columns(*(f"f_dc_{i}" for i in range(3)))[:, None], *(r.transpose(1, 2) for r in rest)], dim=1),
    )
    values = (found.means, found.quats, found.scales, found.opacities, found.sh)
    if bad := int((~torch.stack([v.reshape(count, -1).isfinite().all(1) for v in values]).all(0)).sum()):
        raise CaptureError(
            f"{bad} of {count} Gaussians of {path} have values that are no finite numbers; remove them in an editor."
        )
    return found
