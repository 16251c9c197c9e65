# SPDX-License-Identifier: Apache-2.0
"""Results as text: for the screen while a run goes on, and as the tables of docs/results.md."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any


def print_tables(files: Iterable[str], table: Callable[[Mapping[str, Any]], str]) -> None:
    """Prints results, which are files of JSON, as Markdown."""
    for path in files:
        print(table(json.loads(Path(path).read_text())))


def milliseconds(seconds: float) -> str:
    """Three digits, in milliseconds or, from ten seconds on, seconds."""
    if seconds >= 10.0:
        return f"{seconds:.1f} s"
    value = 1e3 * seconds
    return f"{value:.2f} ms" if value < 10 else f"{value:.1f} ms" if value < 100 else f"{value:.0f} ms"


def _times(factors: Mapping[str, float] | None) -> str:
    if factors is None:
        return "1"
    digits = 0 if factors["median"] >= 20 else 1 if factors["median"] >= 3 else 2
    return f"{factors['median']:.{digits}f} ({factors['least']:.{digits}f} to {factors['most']:.{digits}f})"


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _fact(name: str, value: float) -> str:
    return f"{name} {value:.2f} dB" if name.endswith("psnr") else f"{name} {value:,.6g}"


def _notes(benchmark: Mapping[str, Any], entry: Mapping[str, Any]) -> str:
    facts = entry["facts"]
    notes = [_fact(name, value) for name, value in facts.items() if not name.endswith(("_seconds", "_share"))]
    for name, share in facts.items():
        stage = name.removesuffix("_share")
        if stage != name and share >= 0.001:
            notes.append(f"{stage} {milliseconds(facts[f'{stage}_seconds'])} ({100 * share:.0f} %)")
    if entry["per_second"] is not None:
        notes.insert(0, f"{entry['per_second']:.1f} {benchmark['per_second']}")
    if entry["roofline"] is not None:
        r = entry["roofline"]
        notes.append(
            f"{_digits(r['operations_per_second'] / 1e9)} GFLOP/s; {_digits(100 * r['share_of_roof'])} % of the roof "
            f"at {_digits(r['operations'] / r['bytes'])} operations a byte"
        )
    return "; ".join(notes)


def _target(target: Mapping[str, Any]) -> str:
    if "at_least_times" in target:
        asked, got = f"at least {target['at_least_times']:g} times", f"{target['got']:.1f} times"
    else:
        asked, got = f"at most {milliseconds(target['at_most_seconds'])}", milliseconds(target["got"])
    return f"Target of {target['contestant']}: {asked}; got {got}: {'met' if target['met'] else 'missed'}."


def _quietness(found: Mapping[str, Any]) -> Iterator[str]:
    if found.get("others_share") is not None:
        yield ""
        yield f"Meanwhile other processes took {100 * found['others_share']:.0f} % of the machine."


def variant_lines(benchmark: Mapping[str, Any], variant: Mapping[str, Any]) -> Iterator[str]:
    """One contest as a Markdown table."""
    yield f"**{benchmark['name']}**: {benchmark['work']}; {variant['title']}"
    yield ""
    yield "| contestant | median | least to most | times the first | |"
    yield "| --- | --- | --- | --- | --- |"
    for name, entry in variant["contestants"].items():
        s = entry["seconds"]
        yield (
            f"| {name} | {milliseconds(s['median'])} | {milliseconds(s['least'])} to {milliseconds(s['most'])} "
            f"| {_times(entry['times_faster'])} | {_notes(benchmark, entry)} |"
        )
    for target in variant.get("targets", ()):
        yield ""
        yield _target(target)
    yield from _quietness(variant)
    yield ""


def growth_lines(benchmark: Mapping[str, Any], growth: Mapping[str, Any]) -> Iterator[str]:
    """One growth curve as a Markdown table: sizes across, medians below, the slope at the end."""
    sizes = [point["size"] for point in next(iter(growth["curves"].values()))]
    yield f"**{benchmark['name']}**, growth over {growth['axis']}"
    yield ""
    yield f"| contestant | {' | '.join(f'{size:,.6g}' for size in sizes)} | slope |"
    yield f"|{' --- |' * (len(sizes) + 2)}"
    for name, points in growth["curves"].items():
        cells = (milliseconds(point["seconds"]["median"]) for point in points)
        yield f"| {name} | {' | '.join(cells)} | {growth['slopes'][name]:.2f} |"
        for fact in points[0]["facts"]:
            if fact.endswith("psnr"):
                values = (f"{point['facts'][fact]:.2f}" for point in points)
                yield f"| {name}: {fact}, dB | {' | '.join(values)} | |"
    yield from _quietness(growth)
    yield ""


def environment_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """The command, the machine and its load in one paragraph."""
    m, load = result["machine"], result["load_average"]
    yield f"`{result['command']}`"
    yield ""
    yield (
        f"{m['cpu']}, {m['cores']} cores, kernels for {m['instruction_set']}, torch {m['torch']}, "
        f"Python {m['python']}, commit {m['commit']}; {result['repeats']} rounds; "
        f"load average before {load['before']}, after {load['after']}."
    )
    for threads, peaks in result["peaks"].items():
        yield (
            f"Peak with {threads} thread{'s' if threads != '1' else ''}: "
            f"{peaks['operations_per_second'] / 1e9:.0f} GFLOP/s, {peaks['bytes_per_second'] / 1e9:.1f} GB/s."
        )
    yield ""


def table(result: Mapping[str, Any]) -> str:
    """A JSON result of a run as Markdown."""
    lines = [*environment_lines(result)]
    for benchmark in result["benchmarks"].values():
        for variant in benchmark["variants"]:
            lines += variant_lines(benchmark, variant)
        for growth in benchmark["growth"]:
            lines += growth_lines(benchmark, growth)
    return "\n".join(lines)
