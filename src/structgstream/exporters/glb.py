# SPDX-License-Identifier: Apache-2.0
"""Binary glTF 2.0 with the extension ``KHR_gaussian_splatting``: float32 attributes of points.

Scales and opacities are stored as they are, quaternions as xyzw. ``COLOR_0`` is the constant colour, linear, for
programs that draw points only. y points up, so a capture is turned by half a turn around x.
"""

import json
import struct

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.exporters.bake import BakedGaussians
from structgstream.exporters.formats import FrameOptions
from structgstream.scene.harmonics import Y0

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _UNSIGNED_BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def glb_bytes(gaussians: BakedGaussians, options: FrameOptions | None = None) -> bytes:
    """A whole ``.glb`` file, in the units of ``gaussians`` and the axes of glTF."""
    gaussians = gaussians.y_up()
    constant = (0.5 + Y0 * gaussians.sh[:, 0]).clamp(0.0, 1.0)
    linear = torch.where(constant <= 0.04045, constant / 12.92, ((constant + 0.055) / 1.055) ** 2.4)
    color = torch.cat([linear, gaussians.opacities[:, None]], dim=1)
    columns = {
        "POSITION": gaussians.means,
        "COLOR_0": (color * 255.0).round().clamp(0, 255).to(torch.uint8),
        f"{EXTENSION}:ROTATION": torch.nn.functional.normalize(gaussians.quats, dim=1)[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": gaussians.scales,
        f"{EXTENSION}:OPACITY": gaussians.opacities.clamp(0.0, 1.0)[:, None],
        **{
            f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}": gaussians.sh[:, degree * degree + order]
            for degree in range(gaussians.degree + 1)
            for order in range(2 * degree + 1)
        },
    }
    accessors, views, binary = [], [], bytearray()
    for name, column in columns.items():
        values: NDArray[np.generic] = np.ascontiguousarray(column.cpu().numpy())
        accessor = {
            "bufferView": len(views),
            "componentType": _UNSIGNED_BYTE if values.dtype == np.uint8 else _FLOAT,
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        if name == "POSITION":
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        if values.dtype == np.uint8:
            accessor["normalized"] = True
        accessors.append(accessor)
        data = values.tobytes()  # every column has a multiple of four bytes
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data), "target": _ARRAY_BUFFER})
        binary += data
    primitive = {
        "attributes": {name: place for place, name in enumerate(columns)},
        "mode": _POINTS,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "sortingMethod": "cameraDistance",
                "projection": "perspective",
            }
        },
    }
    document = {
        "asset": {"version": "2.0", "generator": "structgstream"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
