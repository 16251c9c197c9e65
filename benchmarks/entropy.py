# SPDX-License-Identifier: Apache-2.0
"""Entropy coding of residual symbols in 50 contexts: NumPy, the C++, zstd over bytes, and constriction's ANS coder."""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import zstandard

from benchmarks.benchmark import Benchmark, Growth, Target, Variant
from benchmarks.contest import Contestant, Quantity, Results
from structgstream.codec.entropy import rans
from structgstream.codec.entropy.bits import zigzag
from structgstream.codec.entropy.rans import ALPHABET, LARGEST_SYMBOL
from structgstream.codec.entropy.tables import FrequencyTables, choose_tables, decode_tables, geometric_family

CONTEXTS = 50
Symbols = tuple[np.ndarray, np.ndarray, np.ndarray]


def workload(symbols: int) -> Symbols:
    """Symbols u8 ``[n]``, contexts u16 ``[n]``, counts ``[50, 16]``: Laplace residuals of scales 0.2 to 1, rounded."""
    g = np.random.default_rng(5)
    contexts = g.integers(0, CONTEXTS, symbols).astype(np.uint16)
    residuals = np.rint(g.laplace(0, np.linspace(0.2, 1.0, CONTEXTS)[contexts])).astype(np.int64)
    values = zigzag(residuals.clip(-LARGEST_SYMBOL, LARGEST_SYMBOL)).astype(np.uint8)
    counts = np.zeros((CONTEXTS, ALPHABET), np.int64)
    np.add.at(counts, (contexts, values), 1)
    return values, contexts, counts


def defaults() -> FrequencyTables:
    """What a key frame's tables are relative to."""
    return FrequencyTables(geometric_family(ALPHABET)[np.full(CONTEXTS, 100)])


def _symbols(symbols: np.ndarray) -> Results:
    return [torch.from_numpy(symbols.astype(np.int32))]


def _ours(work: Symbols, *, native: bool, lanes: int | None = None) -> Contestant:
    values, contexts, counts = work
    tables, bits = choose_tables(counts, defaults())
    section = rans.encode(values, contexts, tables, lanes=lanes)

    def decode() -> Results:
        return _symbols(rans.decode(section, contexts, decode_tables(bits, defaults()), native=native)[0])

    name = ("cpu" if native else "NumPy reference") + (f", lanes: {lanes}" if lanes else "") + ", 1 thread"
    return _contestant(name, decode, len(bits) + len(section), work)


def _zstd(work: Symbols) -> Contestant:
    packed = zstandard.ZstdCompressor(level=19).compress(work[0].tobytes())
    decoder = zstandard.ZstdDecompressor()
    return _contestant(
        "zstd -19 of a byte a symbol, 1 thread",
        lambda: _symbols(np.frombuffer(decoder.decompress(packed), np.uint8)),
        len(packed),
        work,
    )


def _constriction(work: Symbols) -> Contestant:
    """With exact frequencies, which are not counted in its size."""
    values, contexts, counts = work
    totals = np.maximum(counts.sum(1, keepdims=True), 1)
    probabilities = (counts / totals)[contexts].astype(np.float32)
    stream: Any = importlib.import_module("constriction").stream  # its type stubs leave this out
    model = stream.model.Categorical(perfect=False)
    coder = stream.stack.AnsCoder()
    coder.encode_reverse(values.astype(np.int32), model, probabilities)
    packed = coder.get_compressed()
    return _contestant(
        "constriction, its tables free, 1 thread",
        lambda: _symbols(stream.stack.AnsCoder(packed).decode(model, probabilities)),
        4 * len(packed),
        work,
    )


def _contestant(name: str, run: Callable[[], Results], size_bytes: int, work: Symbols) -> Contestant:
    counts = work[2]
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    entropy_bytes = float(-(counts * np.log2(np.where(share > 0, share, 1))).sum()) / 8
    facts = {"bytes": float(size_bytes), "percent over conditional entropy": 100 * (size_bytes / entropy_bytes - 1)}
    return Contestant(name, run, 1, facts=lambda: facts)


def contestants(*, symbols: int) -> list[Contestant]:
    """Decoding tables and symbols; the NumPy reference first."""
    work = workload(symbols)
    return [
        _ours(work, native=False),
        _ours(work, native=True),
        *(_ours(work, native=True, lanes=lanes) for lanes in rans.LANES),
        _zstd(work),
        _constriction(work),
    ]


BENCHMARK = Benchmark(
    name="entropy",
    work="decoding 300,000 residual symbols in 50 contexts and their tables",
    contestants=contestants,
    quantities=[Quantity("symbols", 0.0, "largest")],
    variants=[
        Variant("300,000 symbols", {"symbols": 300_000}, {"symbols": 2_000}),
        Variant("30,000 symbols", {"symbols": 30_000}, {"symbols": 1_000}),
    ],
    growth=[
        Growth(
            "symbols",
            {n: {"symbols": n} for n in (10_000, 20_000, 40_000, 80_000, 160_000, 320_000)},
            {n: {"symbols": n} for n in (1_000, 2_000)},
            only=("NumPy reference, 1 thread", "cpu, 1 thread"),
        )
    ],
    targets=[Target("cpu, 1 thread", at_most_seconds=0.03)],
)
