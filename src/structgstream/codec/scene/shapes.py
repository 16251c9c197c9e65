# SPDX-License-Identifier: Apache-2.0
"""Consistency of the shapes of a scene's fields (docs/bitstream.md, section Fields): each letter has one size."""

from collections.abc import Mapping

import torch
from torch import Tensor

from structgstream.errors import StreamError
from structgstream.scene.state import FIELDS, FieldName

ENVIRONMENT_ROWS = (1, 4, 9)
"""Numbers of spherical harmonics up to degree 0, 1 and 2."""


def check_shapes(
    fields: Mapping[FieldName, Tensor], *, distance_input: bool, training_cameras: int, where: str
) -> None:
    """Check that the shapes of the fields present are consistent.

    Raises:
        StreamError: naming the first field of another shape, its shape and the expected one.
    """
    sizes: dict[str, int] = {"V": training_cameras}
    for name, value in fields.items():
        _match(name, value, sizes, where)
    if sizes.get("E", 1) not in ENVIRONMENT_ROWS:
        raise StreamError(f"{where} has an environment of {sizes['E']} rows; expected 1, 4 or 9.")
    if not {"K", "D"} <= set(sizes):
        return
    if sizes["K"] < 1 or sizes["D"] < 1:
        raise StreamError(
            f"{where} has {sizes['K']} Gaussians and {sizes['D']} features an anchor; expected at least 1."
        )
    inputs = sizes["D"] + 3 + int(distance_input)
    hidden: int | None = None
    for name, row in FIELDS.items():
        if not row.outputs or name not in fields:
            continue
        weights, outputs = len(fields[name]), row.outputs * sizes["K"]
        units, rest = divmod(weights - outputs, inputs + 1 + outputs)
        if rest or units < 1 or units != (hidden or units):
            raise StreamError(
                f"{where} has an MLP of {weights} weights, which fits no hidden layer between {inputs} inputs and "
                f"{outputs} outputs, or not the size of the other MLPs' hidden layer."
            )
        hidden = units


def _match(name: FieldName, value: Tensor, sizes: dict[str, int], where: str) -> None:
    shape = FIELDS[name].shape
    fits = value.dim() == len(shape) and (value.dtype == torch.int64) == FIELDS[name].integers
    for size, expected in zip(value.shape, shape):
        fits = fits and size == (sizes.setdefault(expected, size) if isinstance(expected, str) else expected)
    if not fits:
        wanted = [str(sizes.get(e, e)) if isinstance(e, str) else str(e) for e in shape]
        raise StreamError(
            f"{where} has field {name} as {tuple(value.shape)} {value.dtype}, which does not fit the others; expected "
            f"({', '.join(wanted)})."
        )
