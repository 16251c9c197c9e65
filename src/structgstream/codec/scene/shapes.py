# SPDX-License-Identifier: Apache-2.0
"""How the fields of a scene fit together (docs/bitstream.md, section Fields): one letter, one size."""

from collections.abc import Mapping

import torch
from torch import Tensor

from structgstream.errors import StreamError
from structgstream.scene.state import FREE_COLUMNS, FieldName

SHAPES: Mapping[FieldName, tuple[str | int, ...]] = {
    "anchor_positions": ("M", 3),
    "offset_scales": ("M", 3),
    "base_scales": ("M", 3),
    "anchor_offsets": ("M", "K", 3),
    "anchor_features": ("M", "D"),
    "opacity_mlp": ("P_alpha",),
    "color_mlp": ("P_c",),
    "covariance_mlp": ("P_Sigma",),
    "free": ("F", FREE_COLUMNS),
    "free_births": ("F",),
    "camera_color": ("V", 6),
    "appearance": ("M", "R"),
    "appearance_basis": ("R", "D"),
    "environment": ("E", 3),
}
"""A number is a size itself; a letter is the same size wherever it stands."""
ENVIRONMENT_ROWS = (1, 4, 9)
"""Spherical harmonics up to degree 0, 1 and 2."""


def check_shapes(
    fields: Mapping[FieldName, Tensor], *, distance_input: bool, training_cameras: int, where: str
) -> None:
    """Refuse fields that contradict each other. Of the init record's fields only those that are there are looked at.

    Raises:
        StreamError: naming the first field that does not fit, its shape and what was expected.
    """
    sizes: dict[str, int] = {"V": training_cameras}
    for name, value in fields.items():
        _match(name, value, sizes, where)
    if sizes.get("E", 1) not in ENVIRONMENT_ROWS:
        raise StreamError(f"{where} has an environment of {sizes['E']} rows; expected 1, 4 or 9.")
    if not {"K", "D"} <= set(sizes):
        return
    if sizes["K"] < 1 or sizes["D"] < 1:
        raise StreamError(f"{where} has {sizes['K']} Gaussians and {sizes['D']} features an anchor; both must be 1 up.")
    inputs = sizes["D"] + 3 + int(distance_input)
    hidden: int | None = None
    for letter, outputs in (("P_alpha", sizes["K"]), ("P_c", 3 * sizes["K"]), ("P_Sigma", 7 * sizes["K"])):
        if letter not in sizes:
            continue
        units, rest = divmod(sizes[letter] - outputs, inputs + 1 + outputs)
        if rest or units < 1 or units != (hidden or units):
            raise StreamError(
                f"{where} has an MLP of {sizes[letter]} weights, which is no hidden layer between {inputs} inputs and "
                f"{outputs} outputs, or not the same as in the other MLPs."
            )
        hidden = units


def _match(name: FieldName, value: Tensor, sizes: dict[str, int], where: str) -> None:
    shape = SHAPES[name]
    fits = value.dim() == len(shape) and (value.dtype == torch.int64) == (name == "free_births")
    for size, expected in zip(value.shape, shape):
        fits = fits and size == (sizes.setdefault(expected, size) if isinstance(expected, str) else expected)
    if not fits:
        wanted = [str(sizes.get(e, e)) if isinstance(e, str) else str(e) for e in shape]
        raise StreamError(
            f"{where} has field {name} as {tuple(value.shape)} {value.dtype}, which does not fit the others; expected "
            f"({', '.join(wanted)})."
        )
