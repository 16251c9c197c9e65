# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes of the clips: boxes, surfaces of revolution, tubes and sheets. Metres, z up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mesh:
    """Vertices ``[P, 3]``, triangles ``[Q, 3]``, texture coordinates ``[P, 2]`` (u to the right, v up)."""

    vertices: Array
    faces: NDArray[np.int64]
    uvs: Array
    smooth: bool = True

    def placed(self, at: ArrayLike, rotation: Array | None = None) -> "Mesh":
        """Rotated about the origin, then moved to ``at``."""
        turned = self.vertices if rotation is None else self.vertices @ rotation.T
        return replace(self, vertices=turned + np.asarray(at, float))

    def normals(self) -> Array:
        """Unit normals ``[P, 3]``: area-weighted, shared by vertices at one place so that seams vanish."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        face_normals = np.cross(b - a, c - a)
        _, place = np.unique(np.round(self.vertices * 1e5).astype(np.int64), axis=0, return_inverse=True)
        place = place.ravel()
        total = np.zeros((int(place.max()) + 1, 3))
        for corner in range(3):
            np.add.at(total, place[self.faces[:, corner]], face_normals)
        normals = total[place]
        return normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12)


Parts = dict[str, tuple[Mesh, str]]  # name -> (mesh, material)


def rotation(axis: str, degrees: float) -> Array:
    """Rotation matrix about ``x``, ``y`` or ``z``, right-handed."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    out = np.eye(3)
    out[j, j], out[j, k], out[k, j], out[k, k] = c, -s, s, c
    return out


def box(size: Sequence[float], *, metres_per_repeat: float = 1.0, atlas: bool = False) -> Mesh:
    """A box about the origin; faces take their texture by length, or with ``atlas`` one cell of 3 x 2."""
    half = np.asarray(size, float) / 2
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    vertices, uvs, faces = [], [], []
    for side in range(6):
        axis, sign = side // 2, side % 2 * 2 - 1
        u, v = [(1, 2), (0, 2), (0, 1)][axis]
        # seen from outside, u must run to the right
        mirror = sign if axis != 1 else -sign
        points = np.zeros((4, 3))
        points[:, axis] = sign * half[axis]
        points[:, u] = mirror * corner[:, 0] * half[u]
        points[:, v] = corner[:, 1] * half[v]
        unit = (corner + 1) / 2
        if atlas:
            unit = (unit + np.array([side % 3, side // 3])) / [3, 2]
        else:
            unit = unit * 2 * half[[u, v]] / metres_per_repeat
        vertices.append(points)
        uvs.append(unit)
        first = side * 4
        faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return Mesh(np.concatenate(vertices), np.array(faces), np.concatenate(uvs), smooth=False)


def sheet(points: Array, uvs: Array) -> Mesh:
    """A smooth surface through ``points [rows, columns, 3]``; ``uvs [rows, columns, 2]``."""
    rows, columns = points.shape[:2]
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (i * columns + j).ravel()
    quad = np.stack([a, a + columns, a + columns + 1, a + 1], -1)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return Mesh(points.reshape(-1, 3), faces, uvs.reshape(-1, 2))


def _grid_uvs(u: Array, v: Array) -> Array:
    return np.stack(np.meshgrid(u, v, indexing="ij"), -1)


def revolved(profile: ArrayLike, *, around: int = 72) -> Mesh:
    """Turns a profile of ``(radius, height)`` about the z axis; u goes around, v along the profile."""
    line = np.asarray(profile, float)
    angle = np.linspace(0, 2 * np.pi, around)
    points = np.stack(
        [
            np.outer(np.cos(angle), line[:, 0]),
            np.outer(np.sin(angle), line[:, 0]),
            np.tile(line[:, 1], (around, 1)),
        ],
        -1,
    )
    return sheet(points, _grid_uvs(angle / (2 * np.pi), _arc_length(line)))


def _arc_length(line: Array) -> Array:
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    return length / length[-1]


def smooth_profile(knots: ArrayLike, *, samples: int = 64) -> Array:
    """A monotone spline through ``knots``, as ``[samples, 2]``."""
    points = np.asarray(knots, float)
    return PchipInterpolator(_arc_length(points), points)(np.linspace(0, 1, samples))


def sphere(radius: float) -> Mesh:
    """A sphere about the origin."""
    polar = np.linspace(0, np.pi, 48)
    return revolved(np.stack([radius * np.sin(polar), -radius * np.cos(polar)], -1))


def tube(path: Array, radius: float | Array, *, around: int = 20) -> Mesh:
    """Round tube of given radius (one, or one a point) along ``path`` ``[S, 3]``; the ends stay open."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-12
    # the reference direction least along the path keeps the frame from collapsing
    reference = np.eye(3)[int(np.argmin(np.abs(tangent).max(axis=0)))]
    side = np.cross(tangent, reference)
    side /= np.linalg.norm(side, axis=1, keepdims=True) + 1e-12
    other = np.cross(tangent, side)
    angle = np.linspace(0, 2 * np.pi, around)[:, None, None]
    reach = np.broadcast_to(radius, len(path))[None, :, None]
    points = path[None] + reach * (np.cos(angle) * side[None] + np.sin(angle) * other[None])
    return sheet(points, _grid_uvs(np.linspace(0, 1, around), np.linspace(0, 1, len(path))))
