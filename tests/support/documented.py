# SPDX-License-Identifier: Apache-2.0
"""Packets read by the documents alone, number by number: Decisions in entropy.md, Compact packets in bitstream.md.

It shares no code with the package and checks nothing but what it needs to go on.
"""

from collections.abc import Iterator

Row = list[int]
FREE = [("free_means", 3), ("free_log_scales", 3), ("free_quats", 4), ("free_logit_opacities", 1), ("free_colors", 3)]
S = [32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834, 57724, 59287, 60565, 61598, 62428, 63090, 63615, 64030]
S += [64357, 64614, 64816, 64974, 65097, 65194, 65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508]


def limited(value: int, least: int, most: int) -> int:
    return max(least, min(most, value))


def lim(value: int, most: int) -> int:
    return limited(value, -most, most)


def bits(value: int, most: int) -> int:
    return min(value.bit_length(), most)


def squash(x: int) -> int:
    x = lim(x, 1983)
    j, f = abs(x) >> 6, abs(x) % 64
    v = S[j] + ((S[j + 1] - S[j]) * f >> 6)
    return limited(65536 - v if x < 0 else v, 32, 65504)


SQUASHED = [squash(x) for x in range(-1983, 1984)]
STRETCHED = [next((x for x in range(-1983, 1984) if SQUASHED[x + 1983] >= 16 * i + 8), 1983) for i in range(4096)]


class Model:
    """Section Models: cells by node, input and context, which come into being when they are first used."""

    def __init__(self, inputs: int) -> None:
        self.chances: dict[tuple[int, int, int], int] = {}
        self.used: dict[tuple[int, int, int], int] = {}
        self.weights: dict[tuple[int, int], int] = {}
        self.inputs = inputs

    def chance(self, node: int, contexts: Row) -> int:
        assert len(contexts) == self.inputs
        self.cells = [(node, k, context) for k, context in enumerate(contexts)]
        self.x = [STRETCHED[self.chances.get(cell, 32768) >> 4] for cell in self.cells]
        weights = [self.weights.get((node, k), 65536 // self.inputs) for k in range(self.inputs)]
        self.p = squash(sum(w * x >> 16 for w, x in zip(weights, self.x, strict=True)))
        return self.p

    def learn(self, yes: int) -> None:
        t = 65536 if yes else 0
        e = t - self.p >> 4
        for (node, k, context), x in zip(self.cells, self.x, strict=True):
            weight = self.weights.get((node, k), 65536 // self.inputs)
            self.weights[node, k] = lim(weight + (x * e + 4096 >> 13), 2**19 - 1)
            cell = (node, k, context)
            q, u = self.chances.get(cell, 32768), self.used.get(cell, 0)
            self.chances[cell] = limited(q + ((t - q) * (65536 // (u + 2)) >> 16), 32, 65504)
            self.used[cell] = min(u + 1, 255)


class Code:
    """Section The arithmetic code."""

    def __init__(self, data: bytes) -> None:
        self.data, self.taken, self.range, self.code = data, 0, 0, 0

    def take(self) -> None:
        self.code = self.code * 256 + (self.data[self.taken] if self.taken < len(self.data) else 0)
        self.taken += 1

    def decide(self, p: int) -> int:
        if not self.range:
            self.range = 2**32 - 1
            for _ in range(4):
                self.take()
        bound = (self.range >> 16) * p
        yes = self.code < bound
        if not yes:
            self.code -= bound
        self.range = bound if yes else self.range - bound
        while self.range < 2**24:
            self.range *= 256
            self.take()
        return int(yes)

    def is_whole(self) -> bool:
        return self.taken == len(self.data) + 3 if self.range else not self.data


class Packet:
    """Section Names: the codes of a packet's fields, and the models."""

    def __init__(self, fields: dict[str, bytes], models: dict[str, Model]) -> None:
        self.codes = {name: Code(data) for name, data in fields.items()}
        self.models = models

    def decide(self, name: str, node: int, contexts: Row) -> int:
        model = self.models.setdefault(name, Model(len(contexts)))
        yes = self.codes[name.split(".")[0]].decide(model.chance(node, contexts))
        model.learn(yes)
        return yes

    def number(self, name: str, contexts: Row) -> int:
        if not self.decide(name, 0, contexts):
            return 0
        sign = -1 if self.decide(name, 1, contexts) else 1
        size = 1
        while size <= 6 and self.decide(name, 1 + size, contexts):
            size += 1
        if size > 6:
            z, r = 0, 1
            while z < 30 and self.decide(name, 8 + min(z, 8), contexts):
                z += 1
            for _ in range(z):
                r = 2 * r + self.codes[name.split(".")[0]].decide(32768)
            size = 6 + r
        return sign * size

    def is_whole(self) -> bool:
        return all(code.is_complete() for code in self.codes.values())


def passes(n: int) -> Iterator[tuple[int, int, int]]:
    """Level, row and distance of its neighbours (0 without) in the order of the passes."""
    for level, (first, step) in enumerate([(0, 16), (8, 16), (4, 8), (2, 4), (1, 2)]):
        for i in range(first, n, step):
            yield level, i, first


def at(values: Row, i: int) -> int:
    return values[i] if 0 <= i < len(values) else 0


def activity(packet: Packet, name: str, history: Row, last: list[Row]) -> Row:
    """Section Rows, activity."""
    n = len(history)
    size = [sum(min(abs(r), 255) for r in row) for row in last]
    parts = [history[b : b + 32] for b in range(0, n, 32)]
    now = [bits(sum(past & 1 for past in part), 5) for part in parts]
    ever = [sum(past > 0 for past in part) for part in parts]
    block = [0] * len(parts)
    for level, b, d in passes(len(parts)):
        beside = at(block, b - d) + at(block, b + d) if d else 0
        one = (now[b] * 3 + beside) * 5 + level
        two = (bits(ever[b], 5) * 11 + at(now, b - 1) + at(now, b + 1)) * 3 + beside
        block[b] = packet.decide(f"{name}.blocks", 0, [one, two])
    active = [0] * n
    for level, i, d in passes(n):
        if not block[i // 32]:
            continue
        beside = at(active, i - d) + at(active, i + d) if d else 0
        beyond = at(active, i - 3 * d) + at(active, i + 3 * d) if d else 0
        wide = sum(at(history, i + step) & 1 for step in range(-8, 9) if step)
        around = sum(at(size, i + step) for step in (-2, -1, 1, 2))
        contexts = [
            (wide * 3 + beside) * 5 + level,
            (bits(size[i], 5) * 3 + beside) * 6 + bits(around, 5),
            ((level * 3 + beyond) * 3 + beside) * 8 + history[i],
        ]
        active[i] = packet.decide(f"{name}.rows", 0, contexts)
    return active


def size_class(v: int) -> int:
    if v < 8:
        return v
    t = v.bit_length() - 1
    return min(2 * t + (v >> t - 1) % 2 + 2, 15)


def residuals(packet: Packet, name: str, last: list[Row], others: Row) -> list[Row]:
    """Section Rows, residuals of the active rows in one group of columns."""
    c = len(last[0]) if last else 0
    found = [[0] * c for _ in last]
    for k in range(c):
        column = [0] * len(last)
        for level, a, d in passes(len(last)):
            own = last[a][k]
            above, below = (at(column, a - d), at(column, a + d)) if d else (0, 0)
            beside = abs(above) + abs(below)
            led = 10 * own + 3 * (above + below) if d else 16 * own
            if not any(last[a]):
                led = 8 * (above + below)
            expected = size_class((abs(led) + 4) // 8) * (-1 if led < 0 else 1)
            within = sum(map(abs, found[a][:k]))
            left = found[a][k - 1] if k else 0
            off = left - last[a][k - 1] if k else 0
            contexts = [
                (lim(own, 8) + 8) * c + k,
                (lim(above, 4) + 4) * 9 + lim(below, 4) + 4,
                (expected + 15) * 5 + level,
                (min(within, 9) * 6 + min(beside, 5)) * c + k,
                (bits(others[a], 5) * c + k) * 16 + size_class(2 * abs(own) + beside),
                ((lim(left, 3) + 3) * 7 + lim(off, 3) + 3) * 7 + lim(own, 3) + 3,
            ]
            column[a] = found[a][k] = packet.number(f"{name}.change", contexts)
    return found


class Rows:
    """Rows of bins, and their last change."""

    def __init__(self, bins: list[Row]) -> None:
        self.bins = bins
        self.forget()

    def forget(self) -> None:
        self.last, self.history = [[0] * len(row) for row in self.bins], [0] * len(self.bins)

    def keep(self, which: Row) -> None:
        self.bins, self.last = [self.bins[i] for i in which], [self.last[i] for i in which]
        self.history = [self.history[i] for i in which]

    def read(self, packet: Packet, groups: list[tuple[str, int, int]]) -> None:
        active = activity(packet, f"{groups[0][0]}.active", self.history, self.last)
        moving = [i for i, flag in enumerate(active) if flag]
        found = [[0] * len(row) for row in self.last]
        others = [0] * len(moving)
        for name, begin, end in groups:
            told = residuals(packet, name, [self.last[i][begin:end] for i in moving], others)
            for a, (i, row) in enumerate(zip(moving, told, strict=True)):
                found[i][begin:end] = row
                others[a] += sum(min(abs(r), 255) for r in row)
        self.last = found
        self.history = [past * 2 % 8 + flag for past, flag in zip(self.history, active, strict=True)]
        self.bins = [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(self.bins, self.last, strict=True)]


def read_free(packet: Packet, free: Rows, births: Row) -> Row:
    """Section Free 3DGs; the births afterwards."""
    alive = [packet.decide("free_births.alive", 0, [past]) for past in free.history]
    which = [i for i, flag in enumerate(alive) if flag]
    free.keep(which)
    births = [births[i] for i in which]
    groups, column = [], 0
    for name, width in FREE:
        groups.append((name.replace("free_", "free.", 1), column, column + width))
        column += width
    free.read(packet, groups)
    n = packet.number("free_births.count", [0])
    frames = [packet.number("free_births.frame", [0]) for _ in range(n)]
    numbers = [packet.number("free_births.number", [int(frame != 0)]) for frame in frames]
    frame = number = 0
    for i, (step, value) in enumerate(zip(frames, numbers, strict=True)):
        frame, number = frame + step, value if step or not i else number + value
        births.append(frame * 2**32 + number)
    read_born(packet, free, n)
    assert births == sorted(set(births))
    return births


def read_born(packet: Packet, free: Rows, n: int) -> None:
    """Section Free 3DGs, step 6."""
    before = free.bins[-1] if free.bins else [0] * 14
    mean = [sum(column) // len(free.bins) for column in zip(*free.bins)] or [0] * 14
    errors, rows = [[0, 0] for _ in range(n)], [before] + [[0] * 14 for _ in range(n)]
    for k in range(14):
        for i in range(n):
            q, p = errors[i][-2:]
            sign = (p > 0) - (p < 0)
            both = min(bits(abs(p), 12) + bits(abs(q), 12), 12)
            error = packet.number("free.born", [k, (k * 13 + bits(abs(p), 12)) * 3 + sign + 1, k * 13 + both])
            errors[i].append(error)
            above, row = rows[i], rows[i + 1]
            if 6 <= k <= 10:
                row[k] = mean[k] + error
            else:
                row[k] = above[k] + error + (row[k - 1] - above[k - 1] if k >= 12 else 0)
    for row in rows[1:]:
        free.bins.append(row)
        free.last.append([0] * 14)
        free.history.append(0)
