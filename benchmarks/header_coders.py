# SPDX-License-Identifier: Apache-2.0
"""The symbols of a stream's first init record coded by adaptive decisions.

    python -m benchmarks.header_coders FILE OUT

`viewer/packages/core/bench/header.mjs` decodes OUT. It begins with the length of a JSON text, u32, and that text: the
bytes of each field, and each array's name, number of values and number of contexts. The contexts of each array follow,
u8, then the bytes of each field. Contexts are those of the init record's frequency tables.
"""

import json
import struct
import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.adaptive import AdaptiveEncoder
from structgstream.codec.entropy.bits import Bins, Contexts, Naturals
from structgstream.codec.entropy.decisions import Models
from structgstream.codec.entropy.rans import SectionEncoder
from structgstream.codec.fields import static_fields
from structgstream.codec.reader import open_stream


class Both(SectionEncoder):
    """Encodes sections, and every array with adaptive decisions."""

    def __init__(self) -> None:
        super().__init__()
        self.adaptive = AdaptiveEncoder(Models(), where="The init record")
        self.arrays: list[tuple[str, NDArray[np.uint8], int]] = []

    def residuals(self, name: str, values: Bins | None, contexts: Contexts, *, count: int) -> Bins:
        assert values is not None
        self._also(name, values, contexts, count)
        return super().residuals(name, values, contexts, count=count)

    def naturals(self, name: str, values: Naturals | None, contexts: Contexts, *, count: int) -> Naturals:
        assert values is not None
        self._also(name, values, contexts, count)
        return super().naturals(name, values, contexts, count=count)

    def _also(self, name: str, values: NDArray[np.integer], contexts: Contexts, count: int) -> None:
        self.arrays.append((name, contexts.astype(np.uint8), count))
        self.adaptive.numbers(name, values.astype(np.int64), [contexts], counts=[count])


def main(file: str, out: str) -> None:
    header = open_stream(file).header
    both = Both()
    with patch.object(static_fields, "SectionEncoder", lambda: both):
        sections = static_fields.encode_fields({**header.static, **header.reference}, header.init_steps)
    fields = both.adaptive.fields()
    arrays = [{"name": name, "values": len(contexts), "contexts": count} for name, contexts, count in both.arrays]
    text = json.dumps({"fields": {name: len(data) for name, data in fields.items()}, "arrays": arrays}).encode()
    pieces = [contexts.tobytes() for _, contexts, _ in both.arrays]
    Path(out).write_bytes(b"".join([struct.pack("<I", len(text)), text, *pieces, *fields.values()]))
    sizes = [sum(map(len, coded.values())) for coded in (sections, fields)]
    values = sum(len(contexts) for _, contexts, _ in both.arrays)
    print(f"{values} values: {sizes[0]} bytes of sections, {sizes[1]} of decisions")


if __name__ == "__main__":
    main(*sys.argv[1:])
