# SPDX-License-Identifier: Apache-2.0
"""Free Gaussians from frame to frame: some die, some change, some are born (docs/bitstream.md, section Free 3DGs)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.coder import Bins, Coder, Contexts, Flags
from structgstream.codec.rows import Change, coded_change
from structgstream.errors import StreamError
from structgstream.scene.state import FREE_COLUMNS

GROUPS = (
    ("free.means", 0, 3),
    ("free.log_scales", 3, 6),
    ("free.quats", 6, 10),
    ("free.logit_opacities", 10, 11),
    ("free.colors", 11, 14),
)
MOST_FREE = 2**18
"""Free Gaussians that a scene may have: a symbol can take less than a bit, so bytes do not bound their number."""
_FRAME_BITS = 32  # a birth is frame * 2^32 + number


@dataclass(frozen=True)
class FreeBins:
    """Free Gaussians as bins.

    Args:
        births: int64 ``[F]``, ascending.
        bins: ``[F, 14]``.
        change: what the last frame did to them; what was born in it did not change.
    """

    births: NDArray[np.int64]
    bins: Bins
    change: Change

    @classmethod
    def none(cls) -> "FreeBins":
        """No free Gaussians."""
        return cls(np.zeros(0, np.int64), np.zeros((0, FREE_COLUMNS), np.int32), Change.none(0, FREE_COLUMNS))

    def unmoved(self) -> "FreeBins":
        """The same, without a last change: what a key frame starts from."""
        return FreeBins(self.births, self.bins, Change.none(len(self.births), FREE_COLUMNS))


def coded_free(coder: Coder, after: FreeBins | None, before: FreeBins, *, where: str) -> FreeBins:
    """Codes what becomes of ``before``; of ``after``, births and bins are looked at.

    Raises:
        StreamError: births do not ascend or are out of range, or there are too many.
    """
    alive = None if after is None else np.isin(before.births, after.births)
    contexts = before.change.active.astype(np.uint16)
    alive = coder.flags("free_births.alive", alive, contexts, count=2)
    old = FreeBins(
        before.births[alive],
        before.bins[alive],
        before.change.select(alive),
    )
    change = None
    new: FreeBins | None = None
    if after is not None:
        kept = np.isin(after.births, before.births)
        change = Change.of(after.bins[kept] - old.bins)
        new = FreeBins(after.births[~kept], after.bins[~kept], Change.none(0, FREE_COLUMNS))
    change = coded_change(coder, change, old.change, groups=GROUPS)
    born = _coded_births(coder, new, most=MOST_FREE - len(old.births), where=where)
    births = np.concatenate([old.births, born.births])
    if not (np.diff(births) > 0).all():
        raise StreamError(f"{where} has births that do not ascend; it is damaged.")
    return FreeBins(
        births,
        np.concatenate([old.bins + change.residuals, born.bins]),
        Change(
            np.concatenate([change.active, np.zeros(len(born.births), np.bool_)]),
            np.concatenate([change.residuals, np.zeros_like(born.bins)]),
        ),
    )


def _coded_births(coder: Coder, new: FreeBins | None, *, most: int, where: str) -> FreeBins:
    count = coder.number("free_births.count", None if new is None else len(new.births))
    if count > most:
        raise StreamError(f"{where} adds {count} free Gaussians, which makes more than {MOST_FREE}.")
    if not count:
        return FreeBins.none()
    nothing = np.zeros(count, np.uint16)
    frames = numbers = fresh = None
    if new is not None:
        if int(new.births.min()) < 0:
            raise StreamError(f"{where} has births below 0.")
        frames = np.diff(new.births >> _FRAME_BITS, prepend=0)
        numbers = np.diff(new.births & (1 << _FRAME_BITS) - 1, prepend=0)
        fresh = frames != 0
        numbers = np.where(fresh, new.births & (1 << _FRAME_BITS) - 1, numbers)
    frames = coder.naturals("free_births.frame", frames, nothing, count=1)
    fresh = frames != 0
    numbers = coder.naturals("free_births.number", numbers, fresh.astype(np.uint16), count=2)
    frame, number = np.cumsum(frames), _restarted_sums(numbers, fresh)
    if int(frame[-1]) >= 1 << 31 or int(number.max()) >= 1 << _FRAME_BITS:
        raise StreamError(f"{where} has births beyond 63 bits; it is damaged.")
    births = (frame << _FRAME_BITS) + number
    columns = np.tile(np.arange(FREE_COLUMNS, dtype=np.uint16), (count, 1))
    steps = None if new is None else _zigzag(np.diff(new.bins.astype(np.int64), axis=0, prepend=0)).ravel()
    contexts: Contexts = columns.ravel()
    steps = coder.naturals("free.born", steps, contexts, count=FREE_COLUMNS).reshape(count, FREE_COLUMNS)
    bins = np.cumsum(np.where(steps % 2 == 1, -(steps >> 1) - 1, steps >> 1), axis=0)
    if count and not -(2**31) <= int(bins.min()) <= int(bins.max()) < 2**31:
        raise StreamError(f"{where} has a bin beyond 32 bits; it is damaged.")
    return FreeBins(births, bins.astype(np.int32), Change.none(count, FREE_COLUMNS))


def _restarted_sums(steps: NDArray[np.int64], fresh: Flags) -> NDArray[np.int64]:
    """Running sums that begin again at every fresh row; the first row is where the first begins."""
    total = np.cumsum(steps)
    starts = np.flatnonzero(fresh | (np.arange(len(steps)) == 0))
    group = np.searchsorted(starts, np.arange(len(steps)), side="right") - 1
    base = total[starts] - steps[starts]
    return total - base[group]


def _zigzag(values: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.where(values < 0, -2 * values - 1, 2 * values)
