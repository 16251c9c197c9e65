# SPDX-License-Identifier: Apache-2.0
"""The encoder's choice of tables: for each row the coding that minimises the bits of table and symbols together.

Costs are integers in units of 2^-16 bit, so the choice is the same on every machine. Decoders do not need this.
"""

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.bits import fixed, golomb, pack_bits, signed_golomb, zigzag
from structgstream.codec.entropy.tables import (
    COST_BITS,
    COUNT_BITS,
    NUMBER_BITS,
    PRECISION_BITS,
    FrequencyTables,
    code_costs,
    geometric_family,
    levels_of,
    logs,
    normalize_counts,
    top_level,
    weighed,
    weights_of,
)
from structgstream.errors import StreamError

_PER_LN2 = 94548  # 2^16 / ln 2
_EXPLICIT_BITS = 2 + 1 + PRECISION_BITS + 1 + 1


@dataclass(frozen=True)
class _Explicit:
    """Explicitly coded rows of one kind for all contexts.

    Args:
        rows: ``[C, A]`` frequencies.
        cost: ``[C]`` of row and symbols, 2^-16 bit.
        levels, references, present: ``[C, A]``.
        number: ``[C]`` geometric row that is the reference, or None for the previous row.
        bitmap: whether presence is coded as one flag per symbol.
    """

    rows: NDArray[np.int64]
    cost: NDArray[np.int64]
    levels: NDArray[np.int64]
    references: NDArray[np.int64]
    present: NDArray[np.bool_]
    number: NDArray[np.int64] | None
    precision: int
    order: int
    bitmap: bool

    def bits(self, context: int | np.integer) -> str:
        """The row of one context as bits."""
        present = np.flatnonzero(self.present[context])
        text = "110" if self.number is None else "111" + fixed(int(self.number[context]), NUMBER_BITS)
        text += fixed(self.precision, PRECISION_BITS) + fixed(self.order, 1) + fixed(self.bitmap, 1)
        if self.bitmap:
            text += "".join(fixed(bool(there), 1) for there in self.present[context])
        else:
            text += fixed(len(present) - 1, COUNT_BITS)
        steps = (self.levels - self.references)[context, present].tolist() if len(present) > 1 else []
        return text + "".join(signed_golomb(step, order=self.order) for step in steps)


def choose_tables(counts: NDArray[np.integer], previous: FrequencyTables) -> tuple[FrequencyTables, bytes]:
    """Tables for counted symbols, and their coding relative to the previous ones.

    Args:
        counts: ``[C, A]``, number of occurrences of each symbol in each context.
        previous: the decoder's tables; a row is kept where a new one would cost more bits than it saves.

    Raises:
        StreamError: counts have another shape than the previous tables, or are too large.
    """
    counts = counts.astype(np.int64)
    if counts.shape != previous.rows.shape or (counts < 0).any() or int(counts.sum()) >= 1 << 31:
        raise StreamError(
            f"Counts {counts.shape} must be of the tables' shape {previous.rows.shape}, 2^31 - 1 at most."
        )
    kept = previous.rows.astype(np.int64)
    family = geometric_family(previous.alphabet).astype(np.int64)
    of_family = (counts @ code_costs()[family].T) + (2 + NUMBER_BITS << COST_BITS)
    number = of_family.argmin(1)
    keep, parametric = _data_cost(counts, kept) + (1 << COST_BITS), of_family.min(1)
    rows, cost = np.where((parametric < keep)[:, None], family[number], kept), np.minimum(keep, parametric)
    pieces = ["10" + fixed(g, NUMBER_BITS) if new else "0" for g, new in zip(number.tolist(), parametric < keep)]
    # Explicit rows are tried only where exact frequencies would save more than the head of such a row.
    least = _data_cost(counts, normalize_counts(counts).rows.astype(np.int64)) + (
        _EXPLICIT_BITS + COUNT_BITS << COST_BITS
    )
    tried = np.flatnonzero(least < cost)
    choices = product((False, True), range(1 << PRECISION_BITS), (0, 1)) if len(tried) else ()
    of_levels = [_level_costs(counts[tried], precision) for precision in range(1 << PRECISION_BITS)]
    for geometric_reference, precision, order in choices:
        references = family[number[tried]] if geometric_reference else kept[tried]
        its_number = number[tried] if geometric_reference else None
        for entry in _explicit(counts[tried], references, its_number, of_levels[precision], precision, order):
            for place in np.flatnonzero(entry.cost < cost[tried]):
                context = tried[place]
                rows[context], cost[context], pieces[context] = entry.rows[place], entry.cost[place], entry.bits(place)
    changes = any(piece != "0" for piece in pieces)
    return FrequencyTables(rows.astype(np.uint16)), pack_bits(pieces) if changes else b""


def _level_costs(counts: NDArray[np.int64], precision: int) -> NDArray[np.int64]:
    """``[C, A, L]``: what each level of each symbol costs all symbols of its row, without the bits of the level."""
    weights = weights_of(np.arange(1, top_level(precision) + 1), precision=precision)
    total = counts.sum(1)[:, None, None]
    return (total * weights * _PER_LN2 >> 12 + precision) - counts[..., None] * logs()[weights >> precision]


def _explicit(
    counts: NDArray[np.int64],
    reference_rows: NDArray[np.int64],
    number: NDArray[np.int64] | None,
    level_costs: NDArray[np.int64],
    precision: int,
    order: int,
) -> list[_Explicit]:
    """Explicit rows with both codings of presence: as a number of symbols, and as a flag per symbol.

    With a fixed scale of the weights (the reference's), the best level of each symbol is independent of the others: it
    balances ``count log2(weight)``, the share that the weight takes from all others, and the bits of the level.
    """
    references = levels_of(reference_rows, precision=precision)
    steps = _step_bits(precision, order)
    levels = 1 + (level_costs + (steps[references - 1] << COST_BITS)).argmin(2)
    bits = steps[references - 1, levels - 1]
    occurs = counts > 0
    alphabet = counts.shape[1]
    last = alphabet - 1 - occurs[:, ::-1].argmax(1)
    found = []
    for bitmap in (False, True):
        present = occurs if bitmap else np.arange(alphabet) <= last[:, None]
        rows = weighed(np.where(present, weights_of(levels, precision=precision), 0))
        size = _EXPLICIT_BITS + (alphabet if bitmap else COUNT_BITS) + (0 if number is None else NUMBER_BITS)
        size = size + np.where(present.sum(1) > 1, (bits * present).sum(1), 0)
        whole = _data_cost(counts, rows) + (size << COST_BITS)
        found.append(_Explicit(rows, whole, levels, references, present, number, precision, order, bitmap))
    return found


def _data_cost(counts: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    return (counts * code_costs()[rows]).sum(1)


@cache
def _step_bits(precision: int, order: int) -> NDArray[np.int64]:
    """Bits from each level (from 1 on) to each other."""
    top = top_level(precision)
    sizes = np.array([len(golomb(zigzag(step), order=order)) for step in range(1 - top, top)], np.int64)
    return sizes[np.arange(top)[None, :] - np.arange(top)[:, None] + top - 1]
