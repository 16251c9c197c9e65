# SPDX-License-Identifier: Apache-2.0
"""Things that stand in more than one scene."""

import numpy as np
from meshes import Mesh, Parts, box, rotation, sheet

Point = tuple[float, float, float]


def picture(width: float, height: float) -> Mesh:
    """An upright pane that faces the cameras."""
    x, z = np.meshgrid([-width / 2, width / 2], [-height / 2, height / 2], indexing="ij")
    return sheet(np.stack([x, np.zeros_like(x), z], -1), np.stack([x / width + 0.5, z / height + 0.5], -1))


def books(at: Point, *, count: int, seed: int, size: float = 1.0, name: str = "book") -> Parts:
    """Books in a row that begins at ``at`` and goes along x, ``size`` times as large as on the shelf of ``table``."""
    rng = np.random.default_rng(seed)
    parts: Parts = {}
    x, y, z = at
    for number in range(count):
        thickness, height = size * rng.uniform(0.028, 0.05), size * rng.uniform(0.15, 0.21)
        book = box((thickness, size * 0.14, height), metres_per_repeat=size * 0.2)
        middle = (x + thickness / 2, y, z + height / 2)
        parts[f"{name}{number}"] = (book.placed(middle, rotation("y", rng.normal(0, 1.0))), f"book{number % 6}")
        x += thickness + size * 0.005
    return parts


def plant(at: Point, *, leaves: int, length: tuple[float, float], seed: int, name: str) -> Parts:
    """Bent leaves that spring from one point."""
    rng = np.random.default_rng(seed)
    parts: Parts = {}
    along = np.linspace(0, 1, 14)[:, None]
    side = np.array([-1.0, 0.0, 1.0])
    for number in range(leaves):
        reach, bend = rng.uniform(*length), rng.uniform(0.3, 1.4)
        out, up = reach * np.sin(along * bend) / bend, reach * along * np.cos(along * bend * 0.8)
        half_width = 0.1 * reach * np.sin(np.pi * np.clip(along, 0.04, 0.985))
        fold = -0.3 * half_width * (1 - np.abs(side))
        points = np.stack(np.broadcast_arrays(out, half_width * side, up + fold), -1)
        uvs = np.stack(np.broadcast_arrays(along, side / 2 + 0.5), -1)
        leaf = sheet(points, uvs).placed(at, rotation("z", rng.uniform(0, 360)))
        parts[f"{name}{number}"] = (leaf, f"leaf{number % 3}")
    return parts
