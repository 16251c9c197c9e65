# SPDX-License-Identifier: Apache-2.0
"""Materials as Mitsuba objects, lights, and the step from a mesh to a Mitsuba shape."""

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np
import textures as tx
from meshes import Mesh

Surface = Any  # Mitsuba's own classes exist only after a variant is chosen
TEAL, NAVY, CREAM, OCHRE, RUST, SAGE, CLARET = (
    (0.16, 0.44, 0.46), (0.13, 0.22, 0.38), (0.86, 0.80, 0.68), (0.82, 0.60, 0.24),
    (0.70, 0.34, 0.20), (0.50, 0.60, 0.46), (0.48, 0.13, 0.16),
)  # fmt: skip
CLOTH = (CLARET, CREAM, NAVY, OCHRE, TEAL, RUST)
BRIGHT = ((0.78, 0.20, 0.16), (0.14, 0.38, 0.60), (0.90, 0.70, 0.20), (0.20, 0.50, 0.32), (0.88, 0.84, 0.74))


def image(values: tx.Texture, repeat: float | tuple[float, float] = 1.0) -> dict[str, Any]:
    """A texture from sRGB values, repeated ``repeat`` times over the unit square of texture coordinates."""
    across, up = repeat if isinstance(repeat, tuple) else (repeat, repeat)
    pixels = np.ascontiguousarray(np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)
    to_uv = mi.ScalarTransform4f().scale([across, up, 1])
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "wrap_mode": "repeat", "to_uv": to_uv}


def painted(
    color: dict[str, Any] | Sequence[float], *, roughness: float, specular: float = 0.5, coat: float = 0.0
) -> Surface:
    """A non-metal: ``color`` is a texture or linear RGB; ``coat`` adds a clear lacquer."""
    base = color if isinstance(color, dict) else {"type": "rgb", "value": list(color)}
    bsdf = {"type": "principled", "base_color": base, "roughness": roughness, "specular": specular,
            "clearcoat": coat, "clearcoat_gloss": 0.92}  # fmt: skip
    return mi.load_dict({"type": "twosided", "bsdf": bsdf})


def metal(name: str, *, along: float, across: float) -> Surface:
    """A conductor (``Cu``, ``Al``, ...) with its own roughness along and across the brushing."""
    bsdf = {"type": "roughconductor", "material": name, "alpha_u": along, "alpha_v": across}
    return mi.load_dict({"type": "twosided", "bsdf": bsdf})


def glass() -> Surface:
    """A thin clear pane."""
    return mi.load_dict({"type": "thindielectric"})


def lights(*, size: float, panel: Sequence[float], window: Sequence[float]) -> dict[str, Any]:
    """A warm panel under the ceiling, a cool window in the left wall, and dim light from the open front.

    Their middles are at ``panel`` and ``window``; both are ``size`` times as long and wide as in the room of ``table``.
    """
    to_world = mi.ScalarTransform4f()

    def area(red: float, green: float, blue: float) -> dict[str, Any]:
        return {"type": "area", "radiance": {"type": "rgb", "value": [red, green, blue]}}

    above = to_world.translate(list(panel)).rotate([1, 0, 0], 180).scale([0.5 * size, 0.35 * size, 1])
    beside = to_world.translate(list(window)).rotate([0, 1, 0], 90).scale([0.55 * size, 0.6 * size, 1])
    return {
        "panel": {"type": "rectangle", "to_world": above, "emitter": area(17.0, 14.8, 12.0)},
        "window": {"type": "rectangle", "to_world": beside, "emitter": area(12.0, 13.2, 15.0)},
        "front": {"type": "constant", "radiance": {"type": "rgb", "value": [0.36, 0.35, 0.34]}},
    }


def shape(name: str, mesh: Mesh, surface: Surface) -> Any:
    """The mesh as a Mitsuba shape of this material."""
    properties = mi.Properties()
    properties["bsdf"] = surface
    out = mi.Mesh(
        name, len(mesh.vertices), len(mesh.faces), has_vertex_normals=mesh.smooth, has_vertex_texcoords=True,
        props=properties,
    )  # fmt: skip
    fields = mi.traverse(out)
    fields["vertex_positions"] = mesh.vertices.astype(np.float32).ravel()
    fields["faces"] = mesh.faces.astype(np.uint32).ravel()
    fields["vertex_texcoords"] = mesh.uvs.astype(np.float32).ravel()
    if mesh.smooth:
        fields["vertex_normals"] = mesh.normals().astype(np.float32).ravel()
    fields.update()
    return out
