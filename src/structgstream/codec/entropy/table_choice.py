# SPDX-License-Identifier: Apache-2.0
"""The encoder's choice of tables: for each row the coding that minimises the bits of table and symbols together.

Costs are integers in units of 2^-16 bit, so the choice is the same on every machine. Decoders do not need this.
"""

from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import NamedTuple

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


class _Form(NamedTuple):
    """How a row is coded explicitly, in the order in which equally cheap ones are preferred.

    Args:
        geometric: whether levels are relative to the geometric row, not to the previous one.
        precision, order: of levels and of their codes.
        bitmap: whether presence is coded as one flag per symbol, not as a number of symbols.
    """

    geometric: bool
    precision: int
    order: int
    bitmap: bool


_FORMS = [_Form(*form) for form in product((False, True), range(1 << PRECISION_BITS), (0, 1), (False, True))]


@dataclass(frozen=True)
class _Explicit:
    """Explicitly coded rows of one precision; axes are flags of presence, order, reference, context and symbol.

    Args:
        rows: ``[2, 2, 2, C, A]`` frequencies.
        cost: ``[2, 2, 2, C]`` of row and symbols, 2^-16 bit.
        steps: ``[2, 2, C, A]``, levels relative to those of the reference.
        present: ``[2, C, A]``.
    """

    rows: NDArray[np.int64]
    cost: NDArray[np.int64]
    steps: NDArray[np.int64]
    present: NDArray[np.bool_]

    def bits(self, form: _Form, context: int, number: int) -> str:
        """The row of one context as bits; ``number`` of its geometric row."""
        flags = self.present[int(form.bitmap), context]
        present = np.flatnonzero(flags)
        text = "111" + fixed(number, NUMBER_BITS) if form.geometric else "110"
        text += fixed(form.precision, PRECISION_BITS) + fixed(form.order, 1) + fixed(form.bitmap, 1)
        text += (
            "".join(fixed(bool(there), 1) for there in flags) if form.bitmap else fixed(len(present) - 1, COUNT_BITS)
        )
        steps = self.steps[form.order, int(form.geometric), context, present].tolist() if len(present) > 1 else []
        return text + "".join(signed_golomb(step, order=form.order) for step in steps)


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
    if len(tried):
        references = np.stack([kept[tried], family[number[tried]]])
        found = [_explicit(counts[tried], references, precision) for precision in range(1 << PRECISION_BITS)]
        costs = np.stack([found[form.precision].cost[_place(form)] for form in _FORMS])
        for place, best in enumerate(costs.argmin(0).tolist()):
            context, form = tried[place], _FORMS[best]
            if costs[best, place] < cost[context]:
                rows[context] = found[form.precision].rows[*_place(form), place]
                pieces[context] = found[form.precision].bits(form, place, int(number[context]))
    changes = any(piece != "0" for piece in pieces)
    return FrequencyTables(rows.astype(np.uint16)), pack_bits(pieces) if changes else b""


def _place(form: _Form) -> tuple[int, int, int]:
    return int(form.bitmap), form.order, int(form.geometric)


def _explicit(counts: NDArray[np.int64], reference_rows: NDArray[np.int64], precision: int) -> _Explicit:
    """Explicit rows of one precision in every form.

    With a fixed scale of the weights (the reference's), the best level of each symbol is independent of the others: it
    balances ``count log2(weight)``, the share that the weight takes from all others, and the bits of the level.

    Args:
        counts: ``[C, A]``.
        reference_rows: ``[2, C, A]``, the previous rows and the geometric ones.
        precision: of levels.
    """
    alphabet = counts.shape[1]
    references = levels_of(reference_rows, precision=precision)
    every = weights_of(np.arange(1, top_level(precision) + 1), precision=precision)
    shares = counts.sum(1)[:, None, None] * every * _PER_LN2 >> 12 + precision
    level_costs = shares - counts[..., None] * logs()[every >> precision]
    step_bits = np.stack([_step_bits(precision, order) for order in (0, 1)])[:, references - 1]
    levels = 1 + (level_costs + (step_bits << COST_BITS)).argmin(-1)
    bits = np.take_along_axis(step_bits, levels[..., None] - 1, -1)[..., 0]
    occurs = counts > 0
    last = alphabet - 1 - occurs[:, ::-1].argmax(1)
    present = np.stack([np.arange(alphabet) <= last[:, None], occurs])
    shown = present[:, None, None]
    rows = weighed(np.where(shown, weights_of(levels, precision=precision), 0))
    of_presence, of_reference = np.array([COUNT_BITS, alphabet]), np.array([0, NUMBER_BITS])
    heads = _EXPLICIT_BITS + of_presence[:, None, None, None] + of_reference[:, None]
    size = heads + np.where(shown.sum(-1) > 1, (bits * shown).sum(-1), 0)
    return _Explicit(rows, _data_cost(counts, rows) + (size << COST_BITS), levels - references, present)


def _data_cost(counts: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    return (counts * code_costs()[rows]).sum(-1)


@cache
def _step_bits(precision: int, order: int) -> NDArray[np.int64]:
    """Bits from each level (from 1 on) to each other."""
    top = top_level(precision)
    sizes = np.array([len(golomb(zigzag(step), order=order)) for step in range(1 - top, top)], np.int64)
    return sizes[np.arange(top)[None, :] - np.arange(top)[:, None] + top - 1]
