# SPDX-License-Identifier: Apache-2.0
"""What entropy coding costs in a stream: ``python -m benchmarks.stream_entropy FILE ...``.

For the init record and for all packets: the bytes of their sections of symbols, tables and heads included, beside the
symbols' empirical entropy given their contexts. It takes the frequencies of every section alone, or those of all
sections of one name in a group of packets, which share their tables; neither pays for telling them.
"""

import sys
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.coder import Contexts, Decoder
from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import StreamReader, open_stream

Counts = dict[str, NDArray[np.int64]]


class Counted:
    """Listens to a decoder: bytes of sections, and their symbols by name of the section and context."""

    def __init__(self) -> None:
        self.bytes = 0
        self.alone_bytes = 0.0
        """Entropy, every section taken alone."""
        self.counts: Counts = {}

    def entropy_bytes(self) -> float:
        """Entropy, all sections of a name taken together."""
        return sum(map(_entropy_bytes, self.counts.values()))

    def section(self, name: str, counts: NDArray[np.int64], size: int) -> None:
        """A section of ``size`` bytes, its symbols counted by context."""
        self.bytes += size
        self.alone_bytes += _entropy_bytes(counts)
        self.counts[name] = self.counts.get(name, np.zeros_like(counts)) + counts

    def add(self, other: "Counted") -> None:
        """Bytes and symbols of another one."""
        self.bytes += other.bytes
        self.alone_bytes += other.alone_bytes
        for name, counts in other.counts.items():
            self.counts[name] = self.counts.get(name, np.zeros_like(counts)) + counts


def _entropy_bytes(counts: NDArray[np.int64]) -> float:
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    return -float((counts * np.log2(np.where(share > 0, share, 1))).sum()) / 8


def counted_parts(path: str) -> Iterator[tuple[PacketKind | None, Counted]]:
    """The init record (None) and every packet of a stream."""
    current = Counted()
    section = Decoder._section

    def listening(self: Decoder, name: str, contexts: Contexts, *, count: int, alphabet: int) -> NDArray[np.uint8]:
        field = name.partition(".")[0]
        before = len(self._left[field])
        symbols = section(self, name, contexts, count=count, alphabet=alphabet)
        counts = np.zeros((count, alphabet), np.int64)
        np.add.at(counts, (contexts, symbols), 1)
        current.section(name, counts, before - len(self._left[field]))
        return symbols

    Decoder._section = listening
    try:
        reader: StreamReader = open_stream(path)
        yield None, current
        for info in reader.packets:
            current = Counted()
            reader.scene(info.index)
            yield info.kind, current
    finally:
        Decoder._section = section


def told(path: str) -> str:
    """One line a part."""
    header, packets, groups = Counted(), Counted(), []
    for kind, part in counted_parts(path):
        if kind is None:
            header = part
            continue
        if kind is PacketKind.KEY:
            groups.append(Counted())
        groups[-1].add(part)
        packets.add(part)
    lines = [path]
    for name, size, entropy in (
        ("init record, each section alone", header.bytes, header.alone_bytes),
        ("packets, each section alone", packets.bytes, packets.alone_bytes),
        ("packets, with the rest of their group", packets.bytes, sum(group.entropy_bytes() for group in groups)),
    ):
        share = f", {100 * (size / entropy - 1):.2f} % over" if entropy else ""
        lines.append(f"  {name}: {size:,} bytes, entropy {entropy:,.0f}{share}")
    return "\n".join(lines)


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(told(argument))
