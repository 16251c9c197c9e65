# SPDX-License-Identifier: Apache-2.0
"""Gaussians after activation for one camera: the input of a rasteriser."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor


def row_indices(rows: Tensor, like: Tensor) -> Tensor:
    """Indices ``[n]`` of the rows of a mask ``[N]`` on the device of ``like``; indices stay what they are.

    Indexing a tensor by a mask counts its rows each time, for which the host waits for the GPU where the mask lies.
    """
    return (rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows).to(like.device)


@dataclass(frozen=True)
class Gaussians:
    """Post-activation Gaussians for one camera.

    Args:
        means: ``[N, 3]`` in scene units.
        quats: ``[N, 4]`` wxyz, not necessarily unit length.
        scales: ``[N, 3]`` standard deviations in scene units.
        opacities: ``[N]`` in [0, 1); those of 0 are not drawn.
        colors: ``[N, 3]`` sRGB.
        ids: ``[N]`` int64, identifies a Gaussian of the scene. See Note [Ids].
        sampling_intervals: ``[N]`` side of a training pixel at the Gaussian, scene units, without gradient, which sets
            its low-pass (``scene/sampling.py``, Note [Drawn as it was trained]); None: that of the drawn picture.

    Note [Ids]
    ~~~~~~~~~~
    Structured Gaussian ``j`` of anchor ``i`` has id ``i * K + j``; free Gaussian in slot ``f`` has ``M * K + f``.
    The opacity mask and culling remove rows *together with their ids*, so that statistics, spawning and pruning can
    index by id without a chain of masks.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    ids: Tensor
    sampling_intervals: Tensor | None = None

    def __len__(self) -> int:
        return self.means.shape[0]

    def detached(self) -> "Gaussians":
        """The same Gaussians without a gradient graph."""
        return Gaussians(**{name: value.detach() for name, value in self.columns().items()})

    def columns(self) -> dict[str, Tensor]:
        """The tensors by name, without intervals if there are none."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) is not None}

    def select(self, rows: Tensor) -> "Gaussians":
        """The rows of a mask ``[N]`` or of indices ``[n]``."""
        rows = row_indices(rows, self.means)
        return Gaussians(**{name: value[rows] for name, value in self.columns().items()})


def concatenate(first: Gaussians, second: Gaussians) -> Gaussians:
    """The rows of ``first``, then those of ``second``; both have sampling intervals, or neither."""
    ones, others = first.columns(), second.columns()
    assert ones.keys() == others.keys(), (sorted(ones), sorted(others))
    return Gaussians(**{name: torch.cat([value, others[name]]) for name, value in ones.items()})


def select_each(sets: Sequence[Gaussians], rows: Tensor) -> list[Gaussians]:
    """Of several sets the rows of one mask ``[N]`` over all of them, on the processor."""
    lengths = list(map(len, sets))
    counts = [int(mask.sum()) for mask in rows.split(lengths)]
    columns, selected = [of.columns() for of in sets], row_indices(rows, sets[0].means)
    parts = [torch.cat([of[name] for of in columns])[selected].split(counts) for name in columns[0]]
    return [Gaussians(**dict(zip(columns[0], of, strict=True))) for of in zip(*parts, strict=True)]
