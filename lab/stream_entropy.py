# SPDX-License-Identifier: Apache-2.0
"""Where a stream's coded bytes go: ``python -m lab.stream_entropy FILE ...``.

For the init record: the bytes of its sections of symbols, tables and heads included, beside the symbols' empirical
entropy given their contexts, which does not pay for telling the frequencies. For all packets: the bytes by name.
"""

import sys
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.adaptive import AdaptiveDecoder
from structgstream.codec.entropy.bits import Contexts
from structgstream.codec.entropy.rans import SectionDecoder
from structgstream.codec.reader import open_stream


class Counted:
    """Listens to a decoder: bytes of sections, and the entropy of their symbols given their contexts."""

    def __init__(self) -> None:
        self.bytes = 0
        self.entropy_bytes = 0.0

    def section(self, counts: NDArray[np.int64], size: int) -> None:
        """A section of ``size`` bytes, its symbols counted by context."""
        share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        self.bytes += size
        self.entropy_bytes -= float((counts * np.log2(np.where(share > 0, share, 1))).sum()) / 8


def counted_init(path: str) -> Counted:
    """The sections of the init record."""
    current = Counted()
    section = SectionDecoder._section

    def listening(
        self: SectionDecoder, name: str, contexts: Contexts, *, count: int, alphabet: int
    ) -> NDArray[np.uint8]:
        field = name.partition(".")[0]
        before = len(self._left[field])
        symbols = section(self, name, contexts, count=count, alphabet=alphabet)
        counts = np.zeros((count, alphabet), np.int64)
        np.add.at(counts, (contexts, symbols), 1)
        current.section(counts, before - len(self._left[field]))
        return symbols

    SectionDecoder._section = listening
    try:
        open_stream(path)
    finally:
        SectionDecoder._section = section
    return current


def packet_bytes(path: str) -> Counter[str]:
    """The bytes of all packets by name; a byte counts where it is taken."""
    found: Counter[str] = Counter()
    before: Counter[str] = Counter()  # of a field, in this packet
    looked_at = AdaptiveDecoder._check_coded

    def listening(self: AdaptiveDecoder, name: str, sound: bool) -> None:
        looked_at(self, name, sound)
        field = name.partition(".")[0]
        taken = min(self._codes[field].place, self._codes[field].size)
        found[name] += taken - before[field]
        before[field] = taken

    AdaptiveDecoder._check_coded = listening
    try:
        reader = open_stream(path)
        for info in reader.packets:
            before.clear()
            reader.scene(info.index)
    finally:
        AdaptiveDecoder._check_coded = looked_at
    return found


def reported(path: str) -> str:
    """One line for the init record, and one for each name."""
    init, packets = counted_init(path), packet_bytes(path)
    share = f", {100 * (init.bytes / init.entropy_bytes - 1):.2f} % over" if init.entropy_bytes else ""
    lines = [path, f"  init record: {init.bytes:,} bytes, entropy {init.entropy_bytes:,.0f}{share}"]
    lines += [f"  {name}: {size:,} bytes" for name, size in sorted(packets.items())]
    return "\n".join([*lines, f"  packets together: {packets.total():,} bytes"])


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(reported(argument))
