# SPDX-License-Identifier: Apache-2.0
"""The documents alone: a second decoder, written from docs/bitstream.md and docs/entropy.md, number by number.

It shares no code with the package and checks nothing but what it needs to go on.
"""

import json
import math
import struct
from collections.abc import Callable

import numpy as np
import zstandard

from tests.support.documented import FREE, Model, Packet, Row, Rows, read_free
from tests.vectors.generate import COMPACT_EXPECTED, COMPACT_STREAM

NAMES = {1: "anchor_positions", 2: "offset_scales", 3: "base_scales", 4: "anchor_offsets", 5: "anchor_features"}
NAMES |= {6: "opacity_mlp", 7: "color_mlp", 8: "covariance_mlp", 9: "free", 10: "free_births", 11: "camera_color"}
NAMES |= {12: "appearance", 13: "appearance_basis", 14: "environment"}


class Bits:
    """Section Bits."""

    def __init__(self, data: bytes) -> None:
        self.text = "".join(f"{byte:08b}" for byte in data)

    def bits(self, count: int) -> int:
        taken, self.text = self.text[:count], self.text[count:]
        assert len(taken) == count
        return int(taken or "0", 2)

    def golomb(self, k: int) -> int:
        z = self.text.index("1")
        self.bits(z)
        return self.bits(z + k + 1) - 2**k

    def signed(self, k: int) -> int:
        v = self.golomb(k)
        return -(v + 1) // 2 if v % 2 else v // 2


def normalised(weights: Row) -> Row:
    """Section Normalised weights."""
    total = sum(weights)
    row = [max(1, 4096 * w // total) if w else 0 for w in weights]
    row[weights.index(max(weights))] += 4096 - sum(row)
    return row


def family(g: int, alphabet: int) -> Row:
    """Section The geometric family."""
    z, q, u, weights = g >> 3, g % 8, 2**16, [0] * alphabet
    for symbol in range(1, alphabet, 2):
        for which in range(symbol, min(symbol + 2, alphabet)):
            weights[which] = max(u, 1)
        u = u * (2 * q + 1) >> 4
    weights[0] = (2 + z % 2) * 2 ** (z >> 1) * sum(weights) >> 4
    return normalised(weights)


def level_of(f: int, p: int) -> int:
    """Section Levels."""
    if f == 0:
        return 1
    e = f.bit_length() - 1
    return 1 + e * 2**p + (f * 2**p // 2**e - 2**p)


def weight_of(level: int, p: int) -> int:
    e, r = divmod(level - 1, 2**p)
    return (2**p + r) * 2**e


def tables_of(bits: Bits, previous: list[Row]) -> list[Row]:
    """Section Table sets."""
    if not bits.text:
        return previous
    found = []
    for before in previous:
        alphabet = len(before)
        if not bits.bits(1):
            found.append(before)
        elif not bits.bits(1):
            found.append(family(bits.bits(8), alphabet))
        else:
            reference = family(bits.bits(8), alphabet) if bits.bits(1) else before
            p, k = bits.bits(2), bits.bits(1)
            if bits.bits(1):
                present = [symbol for symbol in range(alphabet) if bits.bits(1)]
            else:
                present = list(range(bits.bits(5) + 1))
            weights = [0] * alphabet
            for symbol in present:
                step = bits.signed(k) if len(present) > 1 else 0
                weights[symbol] = weight_of(level_of(reference[symbol], p) + step, p)
            found.append(normalised(weights))
    assert "1" not in bits.text
    assert len(bits.text) < 8
    return found


class Fields:
    """Section Coded init fields: the bytes of each field, read from its beginning, and the tables."""

    def __init__(self, data: dict[str, bytes], tables: dict[str, list[Row]]) -> None:
        self.data, self.tables = data, tables

    def take(self, name: str, count: int) -> bytes:
        field = name.split(".")[0]
        taken, self.data[field] = self.data[field][:count], self.data[field][count:]
        assert len(taken) == count
        return taken

    def number(self, name: str) -> int:
        value = shift = 0
        while True:
            byte = self.take(name, 1)[0]
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def section(self, name: str, contexts: Row, c: int, alphabet: int) -> Row:
        previous = self.tables.get(name) or [family(128, alphabet)] * c
        self.tables[name] = rows = tables_of(Bits(self.take(name, self.number(name))), previous)
        n = self.number(name)
        assert n == len(contexts)
        if not n:
            return []
        words, lane_code = divmod(self.number(name), 4)
        lanes = (1, 4, 32)[lane_code]
        states = list(struct.unpack(f"<{lanes}I", self.take(name, 4 * lanes)))
        following = iter(struct.unpack(f"<{words}H", self.take(name, 2 * words)))
        symbols = []
        for i, context in enumerate(contexts):
            row, x = rows[context], states[i % lanes]
            slot, start, s = x % 4096, 0, 0
            while slot >= start + row[s]:
                start, s = start + row[s], s + 1
            x = row[s] * (x >> 12) + slot - start
            states[i % lanes] = x if x >= 2**16 else x * 2**16 + next(following)
            symbols.append(s)
        assert set(states) == {2**16}
        assert next(following, None) is None
        return symbols

    def residuals(self, name: str, contexts: Row, c: int) -> Row:
        symbols = self.section(name, contexts, c, 16)
        escapes = Bits(self.take(name, self.number(name)))
        found = []
        for s in symbols:
            if s < 15:
                found.append(-(s + 1) // 2 if s % 2 else s // 2)
            else:
                size = escapes.golomb(2) + 8
                found.append(-size if escapes.bits(1) else size)
        return found

    def naturals(self, name: str, contexts: Row, c: int) -> Row:
        lengths = self.section(name, contexts, c, 32)
        below = [max(length - 1, 0) for length in lengths]
        rest = Bits(self.take(name, math.ceil(sum(below) / 8)))
        return [2**b + rest.bits(b) if length else 0 for length, b in zip(lengths, below, strict=True)]


def blocks(data: bytes) -> dict[str, tuple[list[int], bytes]]:
    """Section Field blocks: shape and bytes by name."""
    found = {}
    while data:
        code, coding, kind, dimensions = data[:4]
        shape = list(struct.unpack(f"<{dimensions}I", data[4 : 4 + 4 * dimensions]))
        size = math.prod(shape) * (1 if coding else (4, 8)[kind])
        start = 4 + 4 * dimensions
        found[NAMES[code]] = shape, data[start : start + size]
        data = data[start + size :]
    return found


def records(data: bytes) -> list[tuple[int, bytes]]:
    found, start = [], 12
    while start < len(data) - 16:
        length = int.from_bytes(data[start + 4 : start + 8], "little")
        found.append((data[start], data[start + 8 : start + 8 + length]))
        start += 12 + length
    return found


def values(bins: list[Row], step: float) -> list[float]:
    return [float(np.float32(bin) * np.float32(step)) for row in bins for bin in row]


def signed(v: int) -> int:
    return -(v + 1) // 2 if v % 2 else v // 2


def read_positions(fields: Fields) -> list[Row]:
    """Section Positions."""
    name = "anchor_positions"
    m = fields.number(f"{name}.rows")
    origin = [signed(fields.number(f"{name}.origin")) for _ in range(3)]
    descends = fields.number(f"{name}.descends")
    far = fields.naturals(f"{name}.far", [0] * m, 1)
    near = fields.naturals(f"{name}.near", [int(f != 0) for f in far], 2)
    key, found = 0, []
    for v in (f * 2**30 + n for f, n in zip(far, near, strict=True)):
        key += signed(v) if descends else v
        place = [sum((key >> 3 * b + a & 1) << b for b in range(20)) for a in range(3)]
        found.append([p + o for p, o in zip(place, origin, strict=True)])
    return found


def read_anchors(fields: Fields, name: str, before: Row) -> tuple[list[Row], Row]:
    """Section Rows of anchors: bins, and shifts."""
    c, m = fields.number(f"{name}.columns"), len(before)
    shifts = fields.residuals(f"{name}.shift", before, 8)
    found: list[Row] = [[] for _ in range(m)]
    seen = [[0, 0] for _ in range(m)]
    for _ in range(c):
        middle = signed(fields.number(f"{name}.middle"))
        contexts = [s * 5 + min((abs(a) + abs(b)).bit_length(), 4) for s, (a, b) in zip(shifts, seen, strict=True)]
        told = fields.residuals(f"{name}.value", contexts, 40)
        more = iter(fields.naturals(f"{name}.more", [0] * sum(abs(v) == 7 for v in told), 1))
        for i, (v, shift) in enumerate(zip(told, shifts, strict=True)):
            if abs(v) == 7:
                v += next(more) if v > 0 else -next(more)
            half = 2 ** (shift - 1) if shift else 0
            found[i].append((v + (middle + half >> shift)) * 2**shift)
            seen[i] = [seen[i][1], v]
    return found, shifts


def read_init(data: bytes, steps: dict[str, float]) -> dict[str, tuple[int, list[float]]]:
    """Section Coded init fields: width of a row, and numbers, by name; and the fields that are not coded."""
    stored = blocks(data)
    plain = {name: stored.pop(name)[1] for name in ("camera_color",)}
    found = {name: (6, [*struct.unpack(f"<{len(raw) // 4}f", raw)]) for name, raw in plain.items()}
    fields = Fields({name: raw for name, (_, raw) in stored.items()}, {})
    rows = read_positions(fields)
    found["anchor_positions"] = 3, values(rows, steps["anchor_positions"])
    shifts = [0] * len(rows)
    for code in (2, 3, 4, 5, 12):
        name = NAMES[code]
        rows, shifts = read_anchors(fields, name, shifts)
        found[name] = len(rows[0]), values(rows, steps[name])
    for code in (6, 7, 8, 13, 14):
        name = NAMES[code]
        n = fields.number(f"{name}.count")
        bins = [signed(v) for v in fields.naturals(f"{name}.value", [0] * n, 1)]
        found[name] = 1, values([bins], steps[name])
    assert not any(fields.data.values())
    return found


def frames_of(data: bytes, emit: Callable[[dict[str, list[float]]], None]) -> None:
    """Section Compact packets: the fields of every frame."""
    (_, init), *packets, _ = records(data)
    size = int.from_bytes(init[:4], "little")
    header = json.loads(zstandard.ZstdDecompressor().decompress(init[4 : 4 + size]))
    steps, dynamic = header["steps"], header["dynamic"]
    stored = read_init(init[4 + size :], header["init_steps"])
    static = {name: numbers for name, (_, numbers) in stored.items() if name not in dynamic}
    anchors = [name for code, name in NAMES.items() if code <= 3 and name in dynamic]
    weights = [name for code, name in NAMES.items() if 6 <= code <= 8 and name in dynamic]
    models: dict[str, Model] = {}
    rows, births = {"anchors": Rows([]), "free": Rows([])}, []
    for kind, payload in packets:
        if kind == 2:
            bins = {}
            for name in (*anchors, *weights):
                width, numbers = stored[name][0], [round(v / steps[name]) for v in stored[name][1]]
                bins[name] = [numbers[i : i + width] for i in range(0, len(numbers), width)]
            beside = zip(*(bins[name] for name in anchors), strict=True)
            rows = {"anchors": Rows([[bin for part in row for bin in part] for row in beside])}
            rows |= {name: Rows(bins[name]) for name in weights} | {"free": Rows([])}
            births, models = [], {}
        packet = Packet({name: raw for name, (_, raw) in blocks(payload[12:]).items()}, models)
        rows["anchors"].read(packet, [(name, 3 * i, 3 * i + 3) for i, name in enumerate(anchors)])
        for name in weights:
            rows[name].read(packet, [(name, 0, 1)])
        births = read_free(packet, rows["free"], births)
        assert packet.is_whole()
        told = {name: values(rows[name].bins, steps[name]) for name in weights}
        for i, name in enumerate(anchors):
            told[name] = values([row[3 * i : 3 * i + 3] for row in rows["anchors"].bins], steps[name])
        step_of = [steps[name] for name, width in FREE for _ in range(width)]
        told["free"] = [values([[bin]], step)[0] for row in rows["free"].bins for bin, step in zip(row, step_of)]
        emit({**static, **told, "free_births": [float(birth) for birth in births]})
        if kind == 2:
            for kept in rows.values():
                kept.forget()


def test_a_decoder_from_the_documents_alone_reads_the_golden_compact_stream() -> None:
    found: list[dict[str, list[float]]] = []
    frames_of(COMPACT_STREAM.read_bytes(), found.append)
    frames = json.loads(COMPACT_EXPECTED.read_text())["frames"]
    assert len(found) == len(frames) == 6
    for got, frame in zip(found, frames, strict=True):
        assert got.keys() == set(NAMES.values())
        for name, numbers in got.items():
            assert numbers == frame["fields"][name]["values"], (frame["index"], name)
