# SPDX-License-Identifier: Apache-2.0
"""Rows of bins that mostly stay: which ones change, and by how much (docs/bitstream.md, section Rows).

Rows stand in an order in which neighbours belong together. Passes go from every sixteenth row to every second, so that
each row but the first ones has a neighbour on either side that is known.
"""

from collections.abc import Sequence

import numpy as np

from structgstream.codec.entropy.adaptive import AdaptiveCoder
from structgstream.codec.scene.change import Change, row_sizes

_REMEMBERED = 7  # activity of three frames


def code_change(
    coder: AdaptiveCoder, change: Change | None, before: Change, *, groups: Sequence[tuple[str, int, int]]
) -> Change:
    """Codes a change, which is like the one ``before``.

    Args:
        coder: either direction.
        change: what to code; None when decoding.
        before: the same rows' last change.
        groups: ``(name, first column, end)`` of columns that have models of their own, all columns in their order.
    """
    if not groups:
        return before
    active = coder.activity(
        f"{groups[0][0]}.active",
        None if change is None else change.active,
        history=before.history,
        sizes=before.sizes,
    )
    rows = np.flatnonzero(active)
    residuals = np.zeros_like(before.residuals)
    others = np.zeros(len(rows), np.int32)
    for name, first, end in groups:
        given = None if change is None else change.residuals[rows, first:end]
        found = coder.residuals(f"{name}.change", given, last=before.residuals[rows, first:end], others=others)
        residuals[rows, first:end] = found
        others = others + row_sizes(found)
    sizes = np.zeros(len(active), np.int32)
    sizes[rows] = others
    history = (before.history << 1 & _REMEMBERED | active).astype(np.uint8)
    return Change(residuals, history, sizes)
