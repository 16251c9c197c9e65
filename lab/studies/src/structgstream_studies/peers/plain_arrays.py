# SPDX-License-Identifier: Apache-2.0
"""Plain Gaussians as arrays to store, and back: everything that a file says is looked at."""

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.errors import StreamError
from structgstream.scene.color import CameraColor
from structgstream_studies.peers.method import Arrays, stored
from structgstream_studies.peers.plain import MAX_DEGREE, PlainGaussians, degree_of

_SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "logit_opacities": (),
    "base_colors": (3,),
}


def with_prefix(prefix: str, gaussians: PlainGaussians) -> Arrays:
    """Every tensor in float32 as ``prefix_name``."""
    return {f"{prefix}_{name}": stored(value) for name, value in gaussians.tensors().items()}


def tensor_of(
    arrays: Mapping[str, NDArray[Any]],
    name: str,
    shape: tuple[int, ...],
    device: torch.device,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """One array as a tensor of exactly this shape and type.

    Raises:
        StreamError: it is missing or another.
    """
    if name not in arrays:
        raise StreamError(f"The frame has no array {name!r}; it has {', '.join(sorted(arrays)) or 'none'}.")
    value = torch.from_numpy(arrays[name].copy())
    if tuple(value.shape) != shape or value.dtype != dtype:
        raise StreamError(
            f"Array {name!r} is {tuple(value.shape)} {value.dtype}; expected {shape} {dtype}. "
            "The file was made with another configuration, or is damaged."
        )
    return value.to(device)


def gaussians_of(arrays: Mapping[str, NDArray[Any]], prefix: str, device: torch.device) -> PlainGaussians:
    """The inverse of :func:`with_prefix`.

    Raises:
        StreamError: an array is missing or does not fit the others.
    """
    sh, means = arrays.get(f"{prefix}_sh"), arrays.get(f"{prefix}_means")
    if sh is None or means is None or sh.ndim != 3 or means.ndim != 2:
        raise StreamError(f"The frame has no whole set of {prefix} Gaussians.")
    count, coefficients = means.shape[0], sh.shape[1]
    if (degree_of(coefficients) + 1) ** 2 - 1 != coefficients or degree_of(coefficients) > MAX_DEGREE:
        raise StreamError(f"The frame has {coefficients} coefficients a colour, which is no degree up to {MAX_DEGREE}.")
    values = {name: tensor_of(arrays, f"{prefix}_{name}", (count, *shape), device) for name, shape in _SHAPES.items()}
    return PlainGaussians(**values, sh=tensor_of(arrays, f"{prefix}_sh", (count, coefficients, 3), device))


def color_of(arrays: Mapping[str, NDArray[Any]], device: torch.device) -> CameraColor:
    """The training cameras' colour correction.

    Raises:
        StreamError: it is missing or of another shape.
    """
    cameras = arrays["camera_color"].shape[0] if "camera_color" in arrays and arrays["camera_color"].ndim else 0
    gains, biases = tensor_of(arrays, "camera_color", (cameras, 6), device).split((3, 3), dim=1)
    return CameraColor(gains, biases)
